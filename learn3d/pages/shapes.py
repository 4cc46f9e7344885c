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
from learn3d.data.poses import LookAtPoses, Poses
from learn3d.figures.runs import Run
from learn3d.methods.surfaces import grid_surface
from learn3d.pictures.sheets import natural_colors
from learn3d.terminal import plain

UNIT = 1e-4  # of stored coordinates, which are int16: they reach to 3.3, objects to 1
#: Turns row vectors of the object frame into the page's axes, where z is up (in mesh files y is up).
_TO_PAGE = mesh_to_object() @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])

Faces = dict[tuple[str, str, str, str], int]  # (dtype, corners 0, 2, 1 of all triangles) of meshes, and its number


@torch.no_grad()
def pack_shapes(runs: Sequence[Run], samples: Sequence[int], faces: Faces) -> list[dict[str, Any]]:
    """For each of the images the picture and the meshes: one of each run, then the true shape where it is known.

    Triangles go into `faces`, once, as the meshes of most runs have them in common. "reach" is the largest radius.
    """
    largest = max((run.dataset for run in runs), key=lambda dataset: dataset.image_size)
    batch = largest.batch(torch.tensor(samples))
    images = [run.dataset.batch(torch.tensor(samples)).images for run in runs]
    shapes = [run.method.decode(run.method.encode(own)).surfaces() for run, own in zip(runs, images, strict=True)]
    if batch.voxels is not None:
        grids = largest.convention.to_object(batch.voxels).float()
        shapes.append([grid_surface(grid, box=largest.convention.box) for grid in grids])
    pictures = natural_colors(batch.images.numpy(), inverted=largest.inverted)
    eyes = _eyes(batch.poses, len(samples))
    items = []
    for number, sample in enumerate(samples):
        surfaces = [of_run[number] for of_run in shapes]
        points = [np.rint(s.vertices.double().numpy() @ _TO_PAGE / UNIT).clip(-32767, 32767) for s in surfaces]
        items.append(
            {
                "name": plain(largest.object_names[int(batch.object_ids[number])]),
                "view": plain(largest.view_names[int(batch.view_ids[number])]),
                "index": sample,
                "image": _picture(pictures[number]),
                "eye": eyes[number].round(4).tolist(),
                "reach": max([float(np.linalg.norm(p, axis=1).max()) for p in points if len(p)], default=1.0),
                "meshes": [_mesh(p, s.faces.numpy(), faces) for p, s in zip(points, surfaces, strict=True)],
            }
        )
    return items


def _mesh(points: np.ndarray, triangles: np.ndarray, faces: Faces) -> dict[str, Any]:
    """A mesh in plotly's form.

    points [V, 3] in units of `UNIT`; triangles int64 [F, 3], turned over here as the object frame is left-handed.
    """
    dtype = "u2" if len(points) <= 2**16 else "u4"
    key = (dtype, *(_base64(triangles[:, corner], dtype) for corner in (0, 2, 1)))
    packed = {axis: {"dtype": "i2", "bdata": _base64(points[:, n], "i2")} for n, axis in enumerate("xyz")}
    return packed | {"faces": faces.setdefault(key, len(faces)), "empty": len(triangles) == 0}


def _base64(values: np.ndarray, dtype: str) -> str:
    return base64.b64encode(values.astype(f"<{dtype}").tobytes()).decode()


def _picture(rgb: np.ndarray) -> str:
    """An image uint8 [S, S, 3] as the address of a PNG."""
    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "png")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def _eyes(poses: Poses | None, count: int) -> np.ndarray:
    """Directions from the objects to their cameras in the page's axes, float64 [count, 3]; oblique where not known."""
    if poses is None:
        poses = LookAtPoses(torch.full((count,), -30.0), 20.0, 1.0, 15.0)
    eyes = poses.features() if isinstance(poses, LookAtPoses) else -poses.rotation[:, 2]
    eyes = eyes.double().numpy() @ _TO_PAGE
    return eyes / np.linalg.norm(eyes, axis=1, keepdims=True)
