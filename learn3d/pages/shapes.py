"""Shapes for the browser: pictures, meshes and cameras as plain values for plotly's Mesh3d."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image

from learn3d.data.conventions import mesh_to_object
from learn3d.data.poses import LookAtPoses
from learn3d.figures.runs import Run
from learn3d.fitting.smoothing import smooth
from learn3d.methods.surfaces import grid_surface
from learn3d.pictures.sheets import natural_colors
from learn3d.pictures.surfaces import Surface, eyes
from learn3d.terminal import plain

UNIT = 1e-4  # unit of the stored int16 coordinates: they reach to 3.3, objects to 1
#: Turns row vectors of the object frame into the page's axes: z is up (in mesh files y is).
_TO_PAGE = mesh_to_object() @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@torch.no_grad()
def pack_shapes(runs: Sequence[Run], samples: Sequence[int]) -> list[dict[str, Any]]:
    """For each of the images the picture and the meshes: one of each run, then the true shape if it is known.

    "reach" is the largest radius, "eye" the direction of the camera, an oblique one if it is not known.
    """
    dataset = max((run.dataset for run in runs), key=lambda dataset: dataset.image_size)
    batch = dataset.batch(torch.tensor(samples))
    images = [run.dataset.batch(torch.tensor(samples)).images for run in runs]
    shapes = [run.method.decode(run.method.encode(own)).surfaces() for run, own in zip(runs, images, strict=True)]
    if batch.voxels is not None:
        grids = dataset.convention.to_object(batch.voxels).float()
        shapes.append([_smoothed(grid_surface(grid, box=dataset.convention.cube_side)) for grid in grids])
    pictures = natural_colors(batch.images.numpy(), inverted=dataset.inverted)
    oblique = LookAtPoses(torch.full((len(samples),), -30.0), 20.0, 1.0, 15.0)
    cameras = eyes(batch.poses or oblique).numpy() @ _TO_PAGE
    cameras /= np.linalg.norm(cameras, axis=1, keepdims=True)
    items = []
    for number, sample in enumerate(samples):
        surfaces = [of_run[number] for of_run in shapes]
        Image.fromarray(pictures[number]).save(png := io.BytesIO(), "png")
        items.append(
            {
                "name": plain(dataset.object_names[int(batch.object_ids[number])]),
                "view": plain(dataset.view_names[int(batch.view_ids[number])]),
                "index": sample,
                "image": "data:image/png;base64," + base64.b64encode(png.getvalue()).decode(),
                "eye": cameras[number].round(4).tolist(),
                "reach": max([float(s.vertices.norm(dim=1).max()) for s in surfaces if len(s.faces)], default=1) / UNIT,
                "meshes": [_mesh(surface) for surface in surfaces],
            }
        )
    return items


def _smoothed(surface: Surface) -> Surface:
    """Without the steps of its voxels."""
    return Surface(*smooth(surface.vertices, surface.faces, levels=0)) if len(surface.faces) else surface


def _mesh(surface: Surface) -> dict[str, Any]:
    points = np.rint(surface.vertices.double().numpy() @ _TO_PAGE / UNIT).clip(-32767, 32767)
    corners = surface.faces.numpy()[:, [0, 2, 1]]  # turned over: the object frame is left-handed
    packed = {axis: _base64(points[:, n], "i2") for n, axis in enumerate("xyz")}
    kind = "u2" if len(points) <= 2**16 else "u4"
    return packed | {axis: _base64(corners[:, n], kind) for n, axis in enumerate("ijk")} | {"empty": len(corners) == 0}


def _base64(values: np.ndarray, dtype: str) -> dict[str, str]:
    """An array in plotly's form."""
    return {"dtype": dtype, "bdata": base64.b64encode(values.astype(f"<{dtype}").tobytes()).decode()}
