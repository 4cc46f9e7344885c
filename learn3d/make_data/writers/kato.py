"""Writes renderings in Kato's files, and in those of DVR's copy of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import nmr
from learn3d.data import conventions
from learn3d.data.categories import SPLITS, synset_of
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import kato
from learn3d.make_data.writers.writer import WORLD_FROM_OBJECT, RenderedObject, Writer, write_png

NUM_POINTS = 10_000


class KatoWriter(Writer):
    """`{synset}_{split}_images.npz` and `{synset}_{split}_voxels.npz`; objects are kept in memory until the end."""

    fixed_views = True

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._arrays: dict[str, tuple[list[np.ndarray], list[np.ndarray]]] = {split: ([], []) for split in SPLITS}

    @staticmethod
    def paths(category: str) -> tuple[str, ...]:
        return tuple(path.name for split in SPLITS for path in kato.split_paths("", category, split))

    @staticmethod
    def images(item: RenderedObject) -> np.ndarray:
        """Images of an object, uint8 [24, 4, 64, 64]: inverted colours (255 - composite over white) and alpha."""
        return np.concatenate([255 - item.rgb, item.alpha[..., None]], axis=-1).transpose(0, 3, 1, 2)

    @classmethod
    def dataset(cls, objects: Sequence[RenderedObject], category: str, split: str) -> ViewDataset:
        images, voxels = np.zeros((0, 24, 4, 64, 64), np.uint8), np.zeros((0, 32, 32, 32), bool)
        if objects:
            images, voxels = np.stack([cls.images(o) for o in objects]), np.stack([o.voxels for o in objects])
        dataset = kato.from_arrays(images, voxels, category, split)
        return dataclasses.replace(dataset, object_names=tuple(o.name for o in objects))

    def write(self, item: RenderedObject) -> None:
        for kept, array in zip(self._arrays[item.split], (self.images(item), item.voxels), strict=True):
            kept.append(array)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> None:
        for split in objects:
            paths = kato.split_paths(self.folder, self.category, split)
            for path, kept in zip(paths, self._arrays[split], strict=True):
                whole = np.empty((len(kept), *kept[0].shape), kept[0].dtype)
                for index in reversed(range(len(kept))):  # all images are in memory once, not twice
                    whole[index] = kept.pop()
                np.savez_compressed(path, whole)


class DvrWriter(Writer):
    """A folder for each object, and the lists `softras_{split}.lst`.

    World coordinates are ShapeNet's: right-handed, y up, x towards the camera of view 0, longest side 1. The points of
    `pointcloud.npz` are world coordinates. `world_mat_k` [4, 4], whose rotation has determinant 1, takes them to camera
    axes (x right, y down, z away). `camera_mat_k` = diag(f, f, 1, 1), f = 1 / tan 15 deg, takes these to [-1, 1] across
    the image.
    """

    fixed_views = True

    @staticmethod
    def paths(category: str) -> tuple[str, ...]:
        return (synset_of(category),)

    def write(self, item: RenderedObject) -> None:
        folder = self.folder / synset_of(self.category) / item.name
        focal = 1 / np.tan(np.deg2rad(conventions.HALF_FOV_DEG))
        camera, cameras = np.diag([focal, focal, 1.0, 1.0]), {}
        for k, (rgb, alpha, matrix) in enumerate(zip(item.rgb, item.alpha, item.world_to_camera(), strict=True)):
            write_png(folder / "image" / f"{k:04d}.png", rgb)
            write_png(folder / "mask" / f"{k:04d}.png", alpha)
            world = np.vstack([matrix, [0, 0, 0, 1]])
            cameras |= {f"world_mat_{k}": world, f"world_mat_inv_{k}": np.linalg.inv(world)}
            cameras |= {f"camera_mat_{k}": camera, f"camera_mat_inv_{k}": np.linalg.inv(camera)}
        np.savez(folder / "cameras.npz", **cameras)
        generator = torch.Generator().manual_seed(int(item.rng.integers(2**62)))
        points, normals, *_ = nmr.metrics.sample_surface(item.vertices, item.faces, NUM_POINTS, generator)
        turn = WORLD_FROM_OBJECT.T.astype(np.float32)
        np.savez(folder / "pointcloud.npz", points=points.numpy() @ turn, normals=normals.numpy() @ turn)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> None:
        for split, names in objects.items():
            listing = "".join(f"{name}\n" for name in names)
            (self.folder / synset_of(self.category) / f"softras_{split}.lst").write_text(listing)
