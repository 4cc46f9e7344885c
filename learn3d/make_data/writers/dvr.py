"""Writes the layout of DVR's mirror of Kato's renderings (Niemeyer et al. 2020, NMR_Dataset).

`{synset}/{id}/image/0000.png` .. `0023.png` (RGB over white), `mask/0000.png` (grey, 255 = object), `cameras.npz`,
`pointcloud.npz`, and the ids of each split in `{synset}/softras_{split}.lst`.

World coordinates are ShapeNet's: right-handed, y up, x towards the camera of view 0, longest side 1; the points of
`pointcloud.npz` lie in them. `world_mat_k` [4, 4] takes them to camera axes (x right, y down, z away), so its rotation
has determinant 1, and `camera_mat_k` to [-1, 1] across the image (y down): diag(f, f, 1, 1), f = 1 / tan 15 deg.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

import nmr
from learn3d.data import conventions
from learn3d.data.categories import synset_of
from learn3d.data.poses import LookAtPoses
from learn3d.make_data.writers.pictures import write_png
from learn3d.make_data.writers.writer import WORLD_FROM_OBJECT, RenderedObject, Writer

NUM_POINTS = 10_000


class DvrWriter(Writer):
    """Pictures, cameras and surface points of every object in a folder of its own; no voxels."""

    image_size = conventions.IMAGE_SIZE
    default_views = conventions.NUM_VIEWS
    fixed_views = True
    bytes_per_view = 4 * conventions.IMAGE_SIZE**2 + 24 * NUM_POINTS // conventions.NUM_VIEWS
    convention = conventions.KATO  # for the contact sheet
    card: ClassVar = {
        "images": "PNG 64 x 64 over white; masks: grey, anti-aliased",
        "points": f"pointcloud.npz: {NUM_POINTS} points and normals on the surface, in world coordinates",
        "views": "azimuth -15 k, elevation 30, distance 2.732, half field of view 15 degrees",
        "cameras": "cameras.npz: world_mat_k [4, 4], world to camera axes (x right, y down, z away); camera_mat_k",
    }

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return (synset_of(category),)

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        return conventions.view_poses(torch.arange(count))

    def write(self, item: RenderedObject) -> None:
        folder = self.folder / synset_of(self.category) / item.name
        for k, (rgb, alpha) in enumerate(zip(item.rgb, item.alpha, strict=True)):
            write_png(folder / "image" / f"{k:04d}.png", rgb)
            write_png(folder / "mask" / f"{k:04d}.png", alpha)
        np.savez(folder / "cameras.npz", **_camera_arrays(item.poses))
        generator = torch.Generator().manual_seed(int(item.rng.integers(2**62)))
        points, normals, *_ = nmr.metrics.sample_surface(item.vertices, item.faces, NUM_POINTS, generator)
        turn = WORLD_FROM_OBJECT.T.astype(np.float32)
        np.savez(folder / "pointcloud.npz", points=points.numpy() @ turn, normals=normals.numpy() @ turn)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        for split, names in objects.items():
            listing = "".join(f"{name}\n" for name in names)
            (self.folder / synset_of(self.category) / f"softras_{split}.lst").write_text(listing)
        return objects


def _camera_arrays(poses: LookAtPoses) -> dict[str, np.ndarray]:
    focal = 1 / np.tan(np.deg2rad(conventions.HALF_FOV_DEG))
    camera = np.diag([focal, focal, 1.0, 1.0])
    arrays = {}
    for k, matrix in enumerate(poses.cameras().projection().plain().matrix.numpy()):
        world = np.eye(4)
        world[:3] = matrix
        world[:3, :3] = matrix[:, :3] @ WORLD_FROM_OBJECT.T
        arrays |= {f"world_mat_{k}": world, f"world_mat_inv_{k}": np.linalg.inv(world)}
        arrays |= {f"camera_mat_{k}": camera, f"camera_mat_inv_{k}": np.linalg.inv(camera)}
    return arrays
