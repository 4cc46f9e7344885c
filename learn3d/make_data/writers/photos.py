"""Writes a folder of photographs (see `learn3d.data.readers.photos`): continuous views through different lenses.

- `{category}/images/{id}_{view}.png`: RGB, the object on an out-of-focus background
- `{category}/masks/{id}_{view}.png`: grey, 255 where the object is
- `{category}/poses.csv`, one row per picture: file, azimuth_deg, elevation_deg, distance (in lengths of the object's
  longest side), fov_deg (the whole field of view), object, split. The camera looks at the middle of the object, from
  `nmr.points_from_angles(distance, elevation_deg, azimuth_deg)` of the object frame.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import ClassVar

import numpy as np

from learn3d.data import conventions
from learn3d.data.poses import LookAtPoses
from learn3d.make_data.viewpoints import distances, uniform
from learn3d.make_data.writers.pictures import photo_background, write_png
from learn3d.make_data.writers.writer import RenderedObject, Writer

ELEVATIONS_DEG = (-10.0, 50.0)
HALF_FOVS_DEG = (12.0, 25.0)  # lenses of 84 .. 38 mm on a square of 36 mm
COLUMNS = ("file", "azimuth_deg", "elevation_deg", "distance", "fov_deg", "object", "split")


class PhotosWriter(Writer):
    """Pictures, masks and a table in a folder of the category's name; no voxels."""

    image_size = 256
    default_views = 12
    bytes_per_view = 4 * 256**2
    convention = conventions.KATO  # for the contact sheet
    card: ClassVar = {
        "images": "RGB 256 x 256 with a background; masks: grey, anti-aliased",
        "views": "poses.csv: azimuth, elevation, distance, field of view, object and split of every picture",
    }

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._rows: list[tuple[str, ...]] = []

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return (category,)

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        """Any azimuth, elevations in -10 .. 50, another lens for every picture; the whole object is seen."""
        azimuth_deg = uniform(rng, (-180.0, 180.0), count)
        elevation_deg = uniform(rng, ELEVATIONS_DEG, count)
        half_fov_deg = uniform(rng, HALF_FOVS_DEG, count)
        return LookAtPoses(azimuth_deg, elevation_deg, distances(rng, vertices, half_fov_deg), half_fov_deg)

    def write(self, item: RenderedObject) -> None:
        size = self.image_size
        pictures = item.over(np.stack([photo_background(size, size, item.rng) for _ in item.rgb]))
        poses = item.poses
        numbers = np.stack([poses.azimuth_deg, poses.elevation_deg, poses.distance, 2 * poses.half_fov_deg], axis=1)
        for k, (picture, mask, row) in enumerate(zip(pictures, item.alpha, numbers, strict=True)):
            file = f"{item.name}_{k:02d}.png"
            write_png(self.folder / self.category / "images" / file, picture)
            write_png(self.folder / self.category / "masks" / file, mask)
            self._rows.append((file, *(f"{value:.4f}" for value in row), item.name, item.split))

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        with open(self.folder / self.category / "poses.csv", "w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *self._rows])
        return objects
