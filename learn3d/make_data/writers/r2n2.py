"""Writes the layout of R2N2 (Choy et al. 2016)."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from torch import Tensor

from learn3d.data.categories import synset_of
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.r2n2 import DISTANCE, HALF_FOV_DEG, R2N2
from learn3d.make_data.writers.writer import RenderedObject, Writer, uniform, write_png

TRAIN_SHARE = 0.8


class R2n2Writer(Writer):
    """`ShapeNetRendering/{synset}/{id}/rendering/00.png` .., RGBA 137 x 137, and a table of cameras.

    - `rendering_metadata.txt` beside them: a row per image with azimuth, elevation, 0 (in-plane rotation), distance
      ratio, and 25 (an unused field of view; half of the true one is 24.57 degrees). The distance is 1.75 ratios.
    - `ShapeNetVox32/{synset}/{id}/model.binvox`: 32^3, axes x, y, z of the mesh. The grid is the cube around the object
      whose side is the longest side of the bounding box; `translate` and `scale` are its corner and side.
    - Readers sort the ids and take the first 80 % to train on and the rest to test on. So ids begin with a number that
      sorts the objects to train on first, there is no val split, and the share of the test split is fixed.

    Both are in ShapeNet's coordinates (right-handed, y up, front x, the diagonal of the bounding box 1): the eye is at
    d (cos e cos a, sin e, cos e sin a). The object frame is (-z, y, -x) of these, in which the eye of R2N2's azimuth a
    is that of `nmr.points_from_angles(d, e, -a)`.
    """

    image_size = 137
    default_test = 1 - TRAIN_SHARE
    default_val = 0.0
    convention = R2N2
    diagonal = 1.0

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._names: list[str] = []

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return f"ShapeNetRendering/{synset_of(category)}", f"ShapeNetVox32/{synset_of(category)}"

    @classmethod
    def check(cls, output: Path, test: float, augment: int) -> None:
        if round(test, 6) != round(1 - TRAIN_SHARE, 6) or augment:
            raise ValueError(
                "the layout r2n2 has no list of splits: the first 80 % of the sorted ids are for training; leave test "
                f"at 0.2 and augment at 0 (got {test} and {augment}), or choose another layout"
            )

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        """Azimuths in (-360, 0], elevations in [25, 30), distances 1.75 * [0.65, 0.95)."""
        azimuth_deg, elevation_deg = -uniform(rng, (0.0, 360.0), count), uniform(rng, (25.0, 30.0), count)
        distance = uniform(rng, (0.65, 0.95), count).astype(np.float64) * DISTANCE
        return LookAtPoses(azimuth_deg, elevation_deg, distance.astype(np.float32), HALF_FOV_DEG)

    def voxelize(self, vertices: Tensor, faces: Tensor) -> np.ndarray:
        return super().voxelize(vertices / _longest_side(vertices), faces)

    def write(self, item: RenderedObject) -> None:
        name = f"{len(self._names):05d}_{item.name}"
        self._names.append(item.name)
        renderings, volumes = (self.folder / path / name for path in self.paths(self.category))
        for k, rgba in enumerate(item.rgba()):
            write_png(renderings / "rendering" / f"{k:02d}.png", rgba)
        angles = zip(item.poses.azimuth_deg, item.poses.elevation_deg, item.poses.distance, strict=True)
        rows = [f"{-azimuth:.4f} {elevation:.4f} 0 {d / DISTANCE:.4f} 25\n" for azimuth, elevation, d in angles]
        (renderings / "rendering" / "rendering_metadata.txt").write_text("".join(rows))
        volumes.mkdir(parents=True)
        side = _longest_side(item.vertices)
        (volumes / "model.binvox").write_bytes(binvox_bytes(item.voxels, [-side / 2] * 3, side))

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        first = len(self._names) * 8 // 10
        if first == 0:
            raise ValueError("the layout r2n2 needs at least two objects, one to train on and one for test")
        return {"train": self._names[:first], "test": self._names[first:]}


def binvox_bytes(voxels: np.ndarray, translate: list[float], scale: float) -> bytes:
    """Encode a grid bool [D, D, D] with axes x, y, z as binvox: y runs fastest, then z, then x; runs of up to 255."""
    size, corner = " ".join(map(str, voxels.shape)), " ".join(f"{value:.9g}" for value in translate)
    header = f"#binvox 1\ndim {size}\ntranslate {corner}\nscale {scale:.9g}\ndata\n"
    runs = bytearray()
    for cell, run in itertools.groupby(voxels.transpose(0, 2, 1).reshape(-1).tolist()):
        full, rest = divmod(len(list(run)), 255)
        runs += bytes([cell, 255]) * full + (bytes([cell, rest]) if rest else b"")
    return header.encode() + bytes(runs)


def _longest_side(vertices: Tensor) -> float:
    return float((vertices.amax(0) - vertices.amin(0)).max())
