"""Writes Kato's layout (see `learn3d.data.readers.kato`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from learn3d.data import conventions
from learn3d.data.dataset import SPLITS
from learn3d.data.readers import kato
from learn3d.make_data.writers.writer import RenderedObject, Writer


class KatoWriter(Writer):
    """`{synset}_{split}_images.npz`: uint8 [N, 24, 4, 64, 64], RGB = 255 - composite over white, and alpha.

    `{synset}_{split}_voxels.npz`: bool [N, 32, 32, 32], axes (y, x, -z) of the object frame. View k has azimuth -15 k,
    elevation 30, distance 2.732 and half a field of view of 15 degrees.
    """

    fixed_views = True

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._split, self._count = "", 0

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return tuple(path.name for split in SPLITS for path in kato.split_paths("", category, split))

    def start(self, split: str, most: int) -> None:
        self._save()
        self._split, self._count = split, 0
        self._images = np.empty((most, conventions.NUM_VIEWS, 4, self.image_size, self.image_size), dtype=np.uint8)
        self._voxels = np.empty((most, *(conventions.VOXEL_SIZE,) * 3), dtype=bool)

    def write(self, item: RenderedObject) -> None:
        self._images[self._count, :, :3] = 255 - item.rgb.transpose(0, 3, 1, 2)
        self._images[self._count, :, 3] = item.alpha
        self._voxels[self._count] = item.voxels
        self._count += 1

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Images and voxels of the split so far; the split that is being written is kept in memory."""
        return self._images[: self._count], self._voxels[: self._count]

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        self._save()
        return objects

    def _save(self) -> None:
        if self._count:
            paths = kato.split_paths(self.folder, self.category, self._split)
            for path, array in zip(paths, self.arrays(), strict=True):
                np.savez_compressed(path, array)
