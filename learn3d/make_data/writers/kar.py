"""Writes the layout of Kar et al. 2017 (Learnt Stereo Machines; the paper's second data set).

- `renders/{synset}/{id}/render_{i}.png`, RGBA 224 x 224; `depth_{i}.png`, 8-bit grey: 255 where nothing is, and
  0 .. 240 on the object (nearer is darker), so that depth < 250 is the mask; `view.txt`, one row per picture: azimuth
  (-180 .. 180), elevation, an unused 0, distance of the camera (degrees; units of the object frame).
- `renders/{synset}/{id}/camera_{i}.mat`: K [3, 3] in pixels, extrinsic [3, 4] and its rotation as quat (w, x, y, z).
  The published code reads neither extrinsic nor quat. Here they take ShapeNet's coordinates (right-handed, y up,
  front x) to a camera with x right, y down, z away.
- `voxels/modelVoxels32/{synset}/{id}.mat`, key 'Volume', 32^3 in the axes of `readers.kar.KAR`.
- `splits.json`: {synset: {name, train, val, test}}, all categories of the folder in one file.

The camera looks at the origin from `nmr.points_from_angles(distance, elevation, azimuth)` of the object frame; half of
its field of view is 14.9314 degrees.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

import nmr
from learn3d.data.categories import synset_of
from learn3d.data.dataset import SPLITS
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.kar import KAR, read_splits
from learn3d.files.writing import write_json
from learn3d.make_data.viewpoints import distances, uniform
from learn3d.make_data.writers.pictures import write_png
from learn3d.make_data.writers.writer import WORLD_FROM_OBJECT, RenderedObject, Writer

HALF_FOV_DEG = 14.9314  # 60 mm lens, 32 mm sensor
ELEVATIONS_DEG = (-20.0, 40.0)
DEEPEST = 240  # value of the farthest point of an object in depth_{i}.png
NOTHING = 255


class KarWriter(Writer):
    """Renderings, depth and voxels of every object in folders of its own."""

    image_size = 224
    default_views = 20
    bytes_per_view = 5 * 224**2
    convention = KAR
    shared = ("splits.json",)
    card: ClassVar = {
        "images": "RGBA 224 x 224; depth: 8-bit grey, 255 = nothing, 0 .. 240 over 1.8 units around the centre",
        "voxels": "Volume [32, 32, 32], axes (-z, y, x) of the object frame",
        "views": "view.txt: azimuth, elevation, 0, distance; half field of view 14.9314 degrees",
    }

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return f"renders/{synset_of(category)}", f"voxels/modelVoxels32/{synset_of(category)}"

    @classmethod
    def check(cls, output: Path, category: str, test: float, augment: int) -> None:
        _splits_of_others(output)

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        """Azimuths in -180 .. 180, elevations in -20 .. 40; the whole object is seen.

        The distances of Kar's own files are not published; these fill the image about as much as theirs do.
        """
        azimuth_deg = uniform(rng, (-180.0, 180.0), count)
        elevation_deg = uniform(rng, ELEVATIONS_DEG, count)
        distance = distances(rng, vertices, np.full(count, HALF_FOV_DEG))
        return LookAtPoses(azimuth_deg, elevation_deg, distance, HALF_FOV_DEG)

    def write(self, item: RenderedObject) -> None:
        renders, volumes = (self.folder / path for path in self.paths(self.category))
        for i, (rgba, depth) in enumerate(zip(item.rgba(), _depth_images(item), strict=True)):
            write_png(renders / item.name / f"render_{i}.png", rgba)
            write_png(renders / item.name / f"depth_{i}.png", depth)
        _write_cameras(renders / item.name, item.poses)
        poses = zip(item.poses.azimuth_deg, item.poses.elevation_deg, item.poses.distance, strict=True)
        rows = "".join(f"{azimuth:.4f} {elevation:.4f} 0 {distance:.4f}\n" for azimuth, elevation, distance in poses)
        (renders / item.name / "view.txt").write_text(rows)
        volumes.mkdir(parents=True, exist_ok=True)
        _write_mat(volumes / f"{item.name}.mat", Volume=item.voxels)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        entry = {"name": self.category} | {split: objects.get(split, []) for split in SPLITS}
        write_json(self.folder / "splits.json", _splits_of_others(output) | {synset_of(self.category): entry})
        return objects


def _splits_of_others(output: Path) -> dict[str, dict]:
    """What splits.json of the folder holds now, which other categories share; ValueError where it is damaged."""
    return read_splits(output) if (output / "splits.json").exists() else {}


def _depth_images(item: RenderedObject) -> np.ndarray:
    """uint8 [n, 224, 224]: 0 .. 240 where the centre of the pixel sees the object, 255 elsewhere."""
    size = item.alpha.shape[1]
    depth = nmr.render_depth(
        item.vertices, item.faces, item.poses.cameras(), image_size=size, anti_aliasing=False
    ).numpy()
    covered = depth < 100.0  # nmr's `far`
    reach = 0.9  # the box of side 1 lies within 0.87 of the centre
    nearest = item.poses.distance.numpy()[:, None, None] - reach
    level = np.rint((depth - nearest) / (2 * reach) * DEEPEST).clip(0, DEEPEST)
    return np.where(covered, level, NOTHING).astype(np.uint8)


def _write_cameras(folder: Path, poses: LookAtPoses) -> None:
    cameras = poses.cameras().projection().plain()
    for i, matrix in enumerate(cameras.matrix.numpy()):
        rotation = matrix[:, :3] @ WORLD_FROM_OBJECT.T
        focal = KarWriter.image_size / 2 / np.tan(np.deg2rad(HALF_FOV_DEG))
        center = KarWriter.image_size / 2
        _write_mat(
            folder / f"camera_{i}.mat",
            K=np.array([[focal, 0, center], [0, focal, center], [0, 0, 1]]),
            extrinsic=np.concatenate([rotation, matrix[:, 3:]], axis=1),
            quat=np.roll(Rotation.from_matrix(rotation).as_quat(), 1),
        )


def _write_mat(path: Path, **arrays: np.ndarray) -> None:
    """A .mat file without the date of its making: same data, same bytes."""
    content = io.BytesIO()
    savemat(content, arrays)
    header = b"MATLAB 5.0 MAT-file".ljust(116)
    path.write_bytes(header + content.getvalue()[116:])
