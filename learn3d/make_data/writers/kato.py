"""Writes Kato's layout (see `learn3d.data.readers.kato`): two npz files per split."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import torch

from learn3d.data import conventions
from learn3d.data.dataset import SPLITS
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers import kato
from learn3d.make_data.writers.writer import RenderedObject, Writer


class KatoWriter(Writer):
    """`{synset}_{split}_images.npz` and `{synset}_{split}_voxels.npz`; a split is in memory until it is complete."""

    image_size = conventions.IMAGE_SIZE
    default_views = conventions.NUM_VIEWS
    fixed_views = True
    bytes_per_view = 4 * conventions.IMAGE_SIZE**2
    convention = conventions.KATO
    card: ClassVar = {
        "images": "uint8 [N, 24, 4, 64, 64]: RGB = 255 - composite over white, alpha",
        "voxels": "bool [N, 32, 32, 32], axes (y, x, -z) of the object frame",
        "views": "azimuth -15 k, elevation 30, distance 2.732, half field of view 15 degrees",
    }

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._split, self._done = "", 0

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return tuple(path.name for split in SPLITS for path in kato.split_paths("", category, split))

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        return conventions.view_poses(torch.arange(count))

    def start(self, split: str, most: int) -> None:
        self._save()
        self._split, self._done = split, 0
        self._images = np.empty(
            (most, conventions.NUM_VIEWS, 4, conventions.IMAGE_SIZE, conventions.IMAGE_SIZE), dtype=np.uint8
        )
        self._voxels = np.empty((most, *(conventions.VOXEL_SIZE,) * 3), dtype=bool)

    def write(self, item: RenderedObject) -> None:
        self._images[self._done, :, :3] = 255 - item.rgb.transpose(0, 3, 1, 2)
        self._images[self._done, :, 3] = item.alpha
        self._voxels[self._done] = item.voxels
        self._done += 1

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        self._save()
        return objects

    def _save(self) -> None:
        if self._done:
            images, voxels = kato.split_paths(self.folder, self.category, self._split)
            np.savez_compressed(images, self._images[: self._done])
            np.savez_compressed(voxels, self._voxels[: self._done])
        self._done = 0
