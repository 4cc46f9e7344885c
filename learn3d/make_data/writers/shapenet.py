"""Writes renderings in the layouts of Kar et al. 2017 and of 3D-R2N2, with a folder for each object."""

from __future__ import annotations

import io
import itertools
from pathlib import Path

import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from torch import Tensor

import nmr
from learn3d.data.categories import SPLITS, synset_of
from learn3d.data.dataset import DEPTH_REACH
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.kar import KAR, read_splits
from learn3d.data.readers.r2n2 import DISTANCE, HALF_FOV_DEG, R2N2
from learn3d.files.writing import write_json
from learn3d.make_data.writers.writer import RenderedObject, Writer, distances, uniform, write_png

KAR_HALF_FOV_DEG = 14.9314  # 60 mm lens, 32 mm sensor


class KarWriter(Writer):
    """A folder of renderings and a voxel grid for each object, and `splits.json` for all categories.

    `depth_{i}.png` has 0 .. 240 over 1.8 units around the object's centre (nearer is darker), and 255 for background.
    `camera_{i}.mat` has K [3, 3] in pixels, extrinsic [3, 4], and its rotation as quat (w, x, y, z). extrinsic takes
    ShapeNet's coordinates (right-handed, y up, front x) to x right, y down, z away. The published code reads neither
    extrinsic nor quat.
    """

    image_size = 224
    default_views = 20
    convention = KAR
    shared = ("splits.json",)

    @staticmethod
    def paths(category: str) -> tuple[str, ...]:
        return f"renders/{synset_of(category)}", f"voxels/modelVoxels32/{synset_of(category)}"

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        """Azimuths in -180 .. 180, elevations in -20 .. 40; images hold the whole object.

        The distances of Kar's own files are not published; here objects fill about as much of the image.
        """
        azimuth_deg, elevation_deg = uniform(rng, (-180.0, 180.0), count), uniform(rng, (-20.0, 40.0), count)
        distance = distances(rng, vertices, np.full(count, KAR_HALF_FOV_DEG))
        return LookAtPoses(azimuth_deg, elevation_deg, distance, KAR_HALF_FOV_DEG)

    def write(self, item: RenderedObject) -> None:
        renders, volumes = (self.folder / path for path in self.paths(self.category))
        folder, poses, cameras = renders / item.name, item.poses, item.poses.cameras()
        depth = nmr.render_depth(
            item.vertices, item.faces, cameras, image_size=self.image_size, anti_aliasing=False
        ).numpy()
        nearest = poses.distance.numpy()[:, None, None] - DEPTH_REACH
        level = np.rint((depth - nearest) / (2 * DEPTH_REACH) * 240).clip(0, 240)
        level = np.where(depth < 100.0, level, 255).astype(np.uint8)  # 100 is nmr's `far`
        focal, center = self.image_size / 2 / np.tan(np.deg2rad(KAR_HALF_FOV_DEG)), self.image_size / 2
        intrinsics = np.array([[focal, 0, center], [0, focal, center], [0, 0, 1]])
        for i, (rgba, grey, extrinsic) in enumerate(zip(item.rgba(), level, item.world_to_camera(), strict=True)):
            write_png(folder / f"render_{i}.png", rgba)
            write_png(folder / f"depth_{i}.png", grey)
            quaternion = np.roll(Rotation.from_matrix(extrinsic[:, :3]).as_quat(), 1)
            _write_mat(folder / f"camera_{i}.mat", K=intrinsics, extrinsic=extrinsic, quat=quaternion)
        rows = zip(poses.azimuth_deg, poses.elevation_deg, poses.distance, strict=True)
        (folder / "view.txt").write_text("".join(f"{a:.4f} {e:.4f} 0 {d:.4f}\n" for a, e, d in rows))
        volumes.mkdir(parents=True, exist_ok=True)
        _write_mat(volumes / f"{item.name}.mat", Volume=item.voxels)

    def finish(self, output: Path, objects: dict[str, list[str]]) -> None:
        others = read_splits(output) if (output / "splits.json").exists() else {}
        entry = {"name": self.category} | {split: objects.get(split, []) for split in SPLITS}
        write_json(self.folder / "splits.json", others | {synset_of(self.category): entry})


def _write_mat(path: Path, **arrays: np.ndarray) -> None:
    """Write a .mat file without its creation date, so that the same data give the same bytes."""
    content = io.BytesIO()
    savemat(content, arrays)
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(116) + content.getvalue()[116:])


class R2n2Writer(Writer):
    """A folder of renderings and a voxel grid for each object, in ShapeNet's coordinates (bounding box diagonal 1).

    The side of the grid is the longest side of the bounding box. Readers sort the ids and train on the first 80 %, so
    an id begins with a number, and the training objects have the lowest ones.
    """

    image_size = 137
    default_val = 0.0
    fixed_splits = True
    convention = R2N2
    diagonal = 1.0

    def __init__(self, folder: Path, category: str) -> None:
        super().__init__(folder, category)
        self._count = 0

    @staticmethod
    def paths(category: str) -> tuple[str, ...]:
        return f"ShapeNetRendering/{synset_of(category)}", f"ShapeNetVox32/{synset_of(category)}"

    def views(self, vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
        """Azimuths in (-360, 0], elevations in [25, 30), distances 1.75 * [0.65, 0.95)."""
        azimuth_deg, elevation_deg = -uniform(rng, (0.0, 360.0), count), uniform(rng, (25.0, 30.0), count)
        distance = uniform(rng, (0.65, 0.95), count).astype(np.float64) * DISTANCE
        return LookAtPoses(azimuth_deg, elevation_deg, distance.astype(np.float32), HALF_FOV_DEG)

    def voxelize(self, vertices: Tensor, faces: Tensor) -> np.ndarray:
        return super().voxelize(vertices / _longest_side(vertices), faces)

    def write(self, item: RenderedObject) -> None:
        renderings, volumes = (self.folder / p / f"{self._count:05d}_{item.name}" for p in self.paths(self.category))
        self._count += 1
        for k, rgba in enumerate(item.rgba()):
            write_png(renderings / "rendering" / f"{k:02d}.png", rgba)
        angles = zip(item.poses.azimuth_deg, item.poses.elevation_deg, item.poses.distance, strict=True)
        rows = [f"{-azimuth:.4f} {elevation:.4f} 0 {d / DISTANCE:.4f} 25\n" for azimuth, elevation, d in angles]
        (renderings / "rendering" / "rendering_metadata.txt").write_text("".join(rows))
        volumes.mkdir(parents=True)
        (volumes / "model.binvox").write_bytes(binvox_bytes(item.voxels, _longest_side(item.vertices)))

    def split(self, meshes: list[dict]) -> list[dict]:
        used = [mesh for mesh in meshes if "objects" in mesh]
        if (first := len(used) * 8 // 10) == 0:
            raise ValueError("the layout r2n2 needs two objects or more, for training and test; give more meshes")
        used = [mesh | {"split": "train" if k < first else "test"} for k, mesh in enumerate(used)]
        return used + [mesh for mesh in meshes if "objects" not in mesh]


def binvox_bytes(voxels: np.ndarray, side: float) -> bytes:
    """Encode a grid bool [D, D, D] (axes x, y, z) of a cube centred at 0 as binvox: y runs fastest, then z, then x."""
    size, corner = " ".join(map(str, voxels.shape)), " ".join([f"{-side / 2:.9g}"] * 3)
    header = f"#binvox 1\ndim {size}\ntranslate {corner}\nscale {side:.9g}\ndata\n"
    runs = bytearray()
    for cell, run in itertools.groupby(voxels.transpose(0, 2, 1).reshape(-1).tolist()):
        full, rest = divmod(len(list(run)), 255)
        runs += bytes([cell, 255]) * full + (bytes([cell, rest]) if rest else b"")
    return header.encode() + bytes(runs)


def _longest_side(vertices: Tensor) -> float:
    return float((vertices.amax(0) - vertices.amin(0)).max())
