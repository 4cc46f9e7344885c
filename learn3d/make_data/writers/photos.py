"""Writes a folder of photographs (see `learn3d.data.readers.photos`): continuous views through different lenses."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from learn3d.data.poses import LookAtPoses
from learn3d.make_data.writers.writer import RenderedObject, Writer, distances, photo_background, uniform, write_png

COLUMNS = ("file", "azimuth_deg", "elevation_deg", "distance", "fov_deg", "object", "split")


class PhotosWriter(Writer):
    """`{category}/images/{id}_{view}.png`: RGB 256 x 256, the object on an out-of-focus background. No voxels.

    - `{category}/masks/{id}_{view}.png`: grey, anti-aliased, 255 = object.
    - `{category}/poses.csv`, a row per image: file, azimuth_deg, elevation_deg, distance (in lengths of the object's
      longest side), fov_deg (the whole field of view), object, split. The camera looks at the middle of the object,
      from `nmr.points_from_angles(distance, elevation_deg, azimuth_deg)` of the object frame.
    """

    image_size = 256
    default_views = 12

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._rows: list[tuple[str, ...]] = []

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return (category,)

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        """Any azimuth, elevations in -10 .. 50, another lens for each image; the whole object is seen."""
        azimuth_deg, elevation_deg = uniform(rng, (-180.0, 180.0), count), uniform(rng, (-10.0, 50.0), count)
        half_fov_deg = uniform(rng, (12.0, 25.0), count)  # lenses of 84 .. 38 mm on a square of 36 mm
        return LookAtPoses(azimuth_deg, elevation_deg, distances(rng, vertices, half_fov_deg), half_fov_deg)

    def write(self, item: RenderedObject) -> None:
        size, poses = self.image_size, item.poses
        images = item.over(np.stack([photo_background(size, size, item.rng) for _ in item.rgb]))
        numbers = np.stack([poses.azimuth_deg, poses.elevation_deg, poses.distance, 2 * poses.half_fov_deg], axis=1)
        for k, (image, mask, row) in enumerate(zip(images, item.alpha, numbers, strict=True)):
            file = f"{item.name}_{k:02d}.png"
            write_png(self.folder / self.category / "images" / file, image)
            write_png(self.folder / self.category / "masks" / file, mask)
            self._rows.append((file, *(f"{value:.4f}" for value in row), item.name, item.split))

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        with open(self.folder / self.category / "poses.csv", "w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *self._rows])
        return objects
