"""Writes the layout of DVR's mirror of Kato's renderings (Niemeyer et al. 2020, NMR_Dataset)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

import nmr
from learn3d.data import conventions
from learn3d.data.categories import synset_of
from learn3d.make_data.writers.writer import WORLD_FROM_OBJECT, RenderedObject, Writer, write_png

NUM_POINTS = 10_000


class DvrWriter(Writer):
    """`{synset}/{id}/image/0000.png` .. `0023.png` (RGB over white) and `mask/0000.png` (grey, 255 = object).

    `cameras.npz` and `pointcloud.npz` (10,000 points and normals) lie beside them. The ids of each split are in
    `{synset}/softras_{split}.lst`. There are no voxels.

    World coordinates are ShapeNet's: right-handed, y up, x towards the camera of view 0, longest side 1; the points
    lie in them. `world_mat_k` [4, 4] takes them to camera axes (x right, y down, z away), so its rotation has
    determinant 1, and `camera_mat_k` to [-1, 1] across the image (y down): diag(f, f, 1, 1), f = 1 / tan 15 deg.
    """

    fixed_views = True
    extra_bytes_per_view = 24 * NUM_POINTS // conventions.NUM_VIEWS

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return (synset_of(category),)

    def write(self, item: RenderedObject) -> None:
        folder = self.folder / synset_of(self.category) / item.name
        for k, (rgb, alpha) in enumerate(zip(item.rgb, item.alpha, strict=True)):
            write_png(folder / "image" / f"{k:04d}.png", rgb)
            write_png(folder / "mask" / f"{k:04d}.png", alpha)
        np.savez(folder / "cameras.npz", **_camera_arrays(item))
        generator = torch.Generator().manual_seed(int(item.rng.integers(2**62)))
        points, normals, *_ = nmr.metrics.sample_surface(item.vertices, item.faces, NUM_POINTS, generator)
        turn = WORLD_FROM_OBJECT.T.astype(np.float32)
        np.savez(folder / "pointcloud.npz", points=points.numpy() @ turn, normals=normals.numpy() @ turn)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        for split, names in objects.items():
            listing = "".join(f"{name}\n" for name in names)
            (self.folder / synset_of(self.category) / f"softras_{split}.lst").write_text(listing)
        return objects


def _camera_arrays(item: RenderedObject) -> dict[str, np.ndarray]:
    focal = 1 / np.tan(np.deg2rad(conventions.HALF_FOV_DEG))
    camera = np.diag([focal, focal, 1.0, 1.0])
    arrays = {}
    for k, matrix in enumerate(item.world_to_camera()):
        world = np.vstack([matrix, [0, 0, 0, 1]])
        arrays |= {f"world_mat_{k}": world, f"world_mat_inv_{k}": np.linalg.inv(world)}
        arrays |= {f"camera_mat_{k}": camera, f"camera_mat_inv_{k}": np.linalg.inv(camera)}
    return arrays
