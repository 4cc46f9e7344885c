"""Writes renderings in the layouts of Kar et al. 2017 and of 3D-R2N2, with a folder for each object."""

import functools
import io
import itertools
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

import nmr
from learn3d.data.categories import SPLITS, synset_of
from learn3d.data.dataset import DEPTH_REACH
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers.kar import KAR as KAR_AXES
from learn3d.data.readers.kar import read_splits
from learn3d.data.readers.r2n2 import DISTANCE, HALF_FOV_DEG
from learn3d.data.readers.r2n2 import R2N2 as R2N2_AXES
from learn3d.files.writing import write_json
from learn3d.studio.make_data.writers.writer import RenderedObject, Writer, random_views, uniform, write_png

KAR_HALF_FOV_DEG = 14.9314  # 60 mm lens, 32 mm sensor


def _write_kar(objects: Iterable[RenderedObject], category: str, root: Path, output: Path) -> None:
    """Write a folder of renderings and a voxel grid for each object, and `splits.json` for all categories.

    `depth_{i}.png` has 0 .. 240 over 1.8 units around the object's centre (nearer is darker), and 255 for background.
    `camera_{i}.mat` has K [3, 3] in pixels, extrinsic [3, 4], and its rotation as quat (w, x, y, z). extrinsic takes
    ShapeNet's coordinates (right-handed, y up, front x) to x right, y down, z away. The published code reads neither
    extrinsic nor quat.
    """
    renders, volumes = (root / path for path in KAR.paths(category))
    size, lists = KAR.image_size, {split: [] for split in SPLITS}
    focal = size / 2 / np.tan(np.deg2rad(KAR_HALF_FOV_DEG))
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    for item in objects:
        folder, poses, cameras = renders / item.name, item.poses, item.poses.cameras()
        depth = nmr.render_depth(item.vertices, item.faces, cameras, image_size=size, anti_aliasing=False).numpy()
        nearest = poses.distance.numpy()[:, None, None] - DEPTH_REACH
        level = np.rint((depth - nearest) / (2 * DEPTH_REACH) * 240).clip(0, 240)
        level = np.where(depth < 100.0, level, 255).astype(np.uint8)  # 100 is nmr's `far`
        for i, (rgba, grey, extrinsic) in enumerate(zip(item.rgba(), level, item.world_to_camera(), strict=True)):
            write_png(folder / f"render_{i}.png", rgba)
            write_png(folder / f"depth_{i}.png", grey)
            quaternion = np.roll(Rotation.from_matrix(extrinsic[:, :3]).as_quat(), 1)
            _write_mat(folder / f"camera_{i}.mat", K=intrinsics, extrinsic=extrinsic, quat=quaternion)
        rows = zip(poses.azimuth_deg, poses.elevation_deg, poses.distance, strict=True)
        (folder / "view.txt").write_text("".join(f"{a:.4f} {e:.4f} 0 {d:.4f}\n" for a, e, d in rows))
        _write_mat(volumes / f"{item.name}.mat", Volume=item.voxels)
        lists[item.split].append(item.name)
    others = read_splits(output) if (output / "splits.json").exists() else {}
    write_json(root / "splits.json", others | {synset_of(category): {"name": category} | lists})


def _write_mat(path: Path, **arrays: np.ndarray) -> None:
    """Write a .mat file without its creation date, so that the same data give the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    savemat(content := io.BytesIO(), arrays)
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(116) + content.getvalue()[116:])


#: The distances of Kar's own files are not published; here objects fill about as much of the image.
KAR = Writer(
    paths=lambda category: (f"renders/{synset_of(category)}", f"voxels/modelVoxels32/{synset_of(category)}"),
    write=_write_kar,
    views=functools.partial(random_views, (-20.0, 40.0), KAR_HALF_FOV_DEG),
    image_size=224,
    default_views=20,
    convention=KAR_AXES,
    shared=("splits.json",),
)


def _write_r2n2(objects: Iterable[RenderedObject], category: str, root: Path, _: Path) -> None:
    """Write a folder of renderings and a voxel grid for each object, in ShapeNet's coordinates.

    Readers sort the ids and train on the first 80 %, so an id begins with a number in the order of the objects.
    """
    for number, item in enumerate(objects):
        images, volumes = (root / path / f"{number:05d}_{item.name}" for path in R2N2.paths(category))
        for k, rgba in enumerate(item.rgba()):
            write_png(images / "rendering" / f"{k:02d}.png", rgba)
        angles = zip(item.poses.azimuth_deg, item.poses.elevation_deg, item.poses.distance, strict=True)
        rows = [f"{-azimuth:.4f} {elevation:.4f} 0 {d / DISTANCE:.4f} 25\n" for azimuth, elevation, d in angles]
        (images / "rendering" / "rendering_metadata.txt").write_text("".join(rows))
        volumes.mkdir(parents=True)
        side = float((item.vertices.amax(0) - item.vertices.amin(0)).max())
        (volumes / "model.binvox").write_bytes(binvox_bytes(item.voxels, side))


def _r2n2_views(vertices: np.ndarray, count: int, rng: np.random.Generator) -> LookAtPoses:
    """Azimuths in (-360, 0], elevations in [25, 30), distances 1.75 * [0.65, 0.95)."""
    azimuth_deg, elevation_deg = -uniform(rng, (0.0, 360.0), count), uniform(rng, (25.0, 30.0), count)
    distance = uniform(rng, (0.65, 0.95), count).astype(np.float64) * DISTANCE
    return LookAtPoses(azimuth_deg, elevation_deg, distance.astype(np.float32), HALF_FOV_DEG)


def binvox_bytes(voxels: np.ndarray, side: float) -> bytes:
    """Encode a grid bool [D, D, D] (axes x, y, z) of a cube centred at 0 as binvox: y runs fastest, then z, then x."""
    size, corner = " ".join(map(str, voxels.shape)), " ".join([f"{-side / 2:.9g}"] * 3)
    header = f"#binvox 1\ndim {size}\ntranslate {corner}\nscale {side:.9g}\ndata\n"
    runs = bytearray()
    for cell, run in itertools.groupby(voxels.transpose(0, 2, 1).reshape(-1).tolist()):
        full, rest = divmod(len(list(run)), 255)
        runs += bytes([cell, 255]) * full + (bytes([cell, rest]) if rest else b"")
    return header.encode() + bytes(runs)


R2N2 = Writer(
    paths=lambda category: (f"ShapeNetRendering/{synset_of(category)}", f"ShapeNetVox32/{synset_of(category)}"),
    write=_write_r2n2,
    views=_r2n2_views,
    image_size=137,
    default_val=0.0,
    fixed=("test", "val", "augment"),
    fixed_splits=True,
    convention=R2N2_AXES,
    tight_grid=True,
    diagonal=1.0,
)
