"""Writes the layout of Kar et al. 2017 (Learnt Stereo Machines; the paper's second data set)."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

import nmr
from learn3d.data.categories import synset_of
from learn3d.data.dataset import SPLITS
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.kar import KAR, read_splits
from learn3d.files.writing import write_json
from learn3d.make_data.writers.writer import RenderedObject, Writer, distances, uniform, write_png

HALF_FOV_DEG = 14.9314  # 60 mm lens, 32 mm sensor
DEEPEST = 240  # value of the farthest point of an object in depth_{i}.png
NOTHING = 255
REACH = 0.9  # a box of side 1 lies within 0.87 of its centre


class KarWriter(Writer):
    """`renders/{synset}/{id}/render_{i}.png`, RGBA 224 x 224, with depth and cameras beside them.

    - `depth_{i}.png`: 8-bit grey, 255 on the background and 0 .. 240 on the object (nearer is darker), over 1.8 units
      around the centre, so that depth < 250 is the mask.
    - `view.txt`: a row per image with azimuth (-180 .. 180), elevation, an unused 0 and the distance of the camera
      (degrees; units of the object frame). The camera looks at the origin from `nmr.points_from_angles(distance,
      elevation, azimuth)`; half of its field of view is 14.9314 degrees.
    - `camera_{i}.mat`: K [3, 3] in pixels, extrinsic [3, 4] and its rotation as quat (w, x, y, z). The published code
      reads neither extrinsic nor quat; here they take ShapeNet's coordinates (right-handed, y up, front x) to a camera
      with x right, y down, z away.
    - `voxels/modelVoxels32/{synset}/{id}.mat`: 'Volume' [32, 32, 32], axes (-z, y, x) of the object frame.
    - `splits.json`: {synset: {name, train, val, test}}, all categories of the folder in one file.
    """

    image_size = 224
    default_views = 20
    convention = KAR
    shared = ("splits.json",)

    @classmethod
    def paths(cls, category: str) -> tuple[str, ...]:
        return f"renders/{synset_of(category)}", f"voxels/modelVoxels32/{synset_of(category)}"

    @classmethod
    def check(cls, output: Path, test: float, augment: int) -> None:
        _read_splits(output)

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        """Azimuths in -180 .. 180, elevations in -20 .. 40; the whole object is seen.

        The distances of Kar's own files are not published; these fill the image about as much as theirs do.
        """
        azimuth_deg, elevation_deg = uniform(rng, (-180.0, 180.0), count), uniform(rng, (-20.0, 40.0), count)
        distance = distances(rng, vertices, np.full(count, HALF_FOV_DEG))
        return LookAtPoses(azimuth_deg, elevation_deg, distance, HALF_FOV_DEG)

    def write(self, item: RenderedObject) -> None:
        renders, volumes = (self.folder / path for path in self.paths(self.category))
        folder, poses = renders / item.name, item.poses
        focal, center = self.image_size / 2 / np.tan(np.deg2rad(HALF_FOV_DEG)), self.image_size / 2
        intrinsics = np.array([[focal, 0, center], [0, focal, center], [0, 0, 1]])
        views = zip(item.rgba(), self._depth_images(item), item.world_to_camera(), strict=True)
        for i, (rgba, depth, extrinsic) in enumerate(views):
            write_png(folder / f"render_{i}.png", rgba)
            write_png(folder / f"depth_{i}.png", depth)
            quaternion = np.roll(Rotation.from_matrix(extrinsic[:, :3]).as_quat(), 1)
            _write_mat(folder / f"camera_{i}.mat", K=intrinsics, extrinsic=extrinsic, quat=quaternion)
        angles = zip(poses.azimuth_deg, poses.elevation_deg, poses.distance, strict=True)
        rows = [f"{azimuth:.4f} {elevation:.4f} 0 {distance:.4f}\n" for azimuth, elevation, distance in angles]
        (folder / "view.txt").write_text("".join(rows))
        volumes.mkdir(parents=True, exist_ok=True)
        _write_mat(volumes / f"{item.name}.mat", Volume=item.voxels)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> dict[str, list[str]]:
        entry = {"name": self.category} | {split: objects.get(split, []) for split in SPLITS}
        write_json(self.folder / "splits.json", _read_splits(output) | {synset_of(self.category): entry})
        return objects

    def _depth_images(self, item: RenderedObject) -> np.ndarray:
        """Depth uint8 [n, 224, 224]: 0 .. 240 if the centre of the pixel sees the object, else 255."""
        cameras = item.poses.cameras()
        depth = nmr.render_depth(
            item.vertices, item.faces, cameras, image_size=self.image_size, anti_aliasing=False
        ).numpy()
        nearest = item.poses.distance.numpy()[:, None, None] - REACH
        level = np.rint((depth - nearest) / (2 * REACH) * DEEPEST).clip(0, DEEPEST)
        return np.where(depth < 100.0, level, NOTHING).astype(np.uint8)  # 100 is nmr's `far`


def _read_splits(output: Path) -> dict[str, dict]:
    """Entries of splits.json for all categories; empty if the file is missing, ValueError if it is damaged."""
    return read_splits(output) if (output / "splits.json").exists() else {}


def _write_mat(path: Path, **arrays: np.ndarray) -> None:
    """Write a .mat file without its creation date, so that the same data give the same bytes."""
    content = io.BytesIO()
    savemat(content, arrays)
    header = b"MATLAB 5.0 MAT-file".ljust(116)
    path.write_bytes(header + content.getvalue()[116:])
