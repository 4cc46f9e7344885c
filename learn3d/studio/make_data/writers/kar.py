"""Writes renderings in the layout of Kar et al. 2017, with a folder for each object."""

import functools
import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

import nmr
from learn3d.data.conventions import KAR, SPLITS, synset_of
from learn3d.data.dataset import DEPTH_REACH
from learn3d.data.readers.kar import HALF_FOV_DEG, read_splits
from learn3d.files.writing import write_json
from learn3d.studio.make_data.writers.writer import RenderedObject, Writer, random_views, write_png


def _write_kar(objects: Iterable[RenderedObject], category: str, root: Path, output: Path) -> None:
    """Write renderings and a voxel grid for each object, and `splits.json` for all categories.

    `depth_{i}.png` has 0 .. 240 over 1.8 units around the object's centre (nearer is darker), and
    255 for background. `camera_{i}.mat` has K [3, 3] in pixels, extrinsic [3, 4], and its
    rotation as quat (w, x, y, z). extrinsic takes ShapeNet's coordinates (right-handed, y up,
    front x) to x right, y down, z away. The published code reads neither extrinsic nor quat.
    """
    renders, volumes = (root / path for path in KAR_WRITER.paths(category))
    size, lists = KAR_WRITER.image_size, {split: [] for split in SPLITS}
    focal = size / 2 / np.tan(np.deg2rad(HALF_FOV_DEG))
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    for item in objects:
        folder, poses, cameras = renders / item.name, item.poses, item.poses.cameras()
        depth = nmr.render_depth(
            item.vertices, item.faces, cameras, image_size=size, anti_aliasing=False
        ).numpy()
        nearest = poses.distance.numpy()[:, None, None] - DEPTH_REACH
        level = np.rint((depth - nearest) / (2 * DEPTH_REACH) * 240).clip(0, 240)
        level = np.where(depth < 100.0, level, 255).astype(np.uint8)  # 100 is nmr's `far`
        for i, (rgba, grey, extrinsic) in enumerate(
            zip(item.rgba(), level, item.world_to_camera(), strict=True)
        ):
            write_png(folder / f"render_{i}.png", rgba)
            write_png(folder / f"depth_{i}.png", grey)
            quaternion = np.roll(Rotation.from_matrix(extrinsic[:, :3]).as_quat(), 1)
            _write_mat(
                folder / f"camera_{i}.mat", K=intrinsics, extrinsic=extrinsic, quat=quaternion
            )
        rows = zip(poses.azimuth_deg, poses.elevation_deg, poses.distance, strict=True)
        (folder / "view.txt").write_text(
            "".join(f"{a:.4f} {e:.4f} 0 {d:.4f}\n" for a, e, d in rows)
        )
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
KAR_WRITER = Writer(
    paths=lambda category: (
        f"renders/{synset_of(category)}",
        f"voxels/modelVoxels32/{synset_of(category)}",
    ),
    write=_write_kar,
    views=functools.partial(random_views, (-20.0, 40.0), HALF_FOV_DEG),
    image_size=224,
    default_views=20,
    convention=KAR,
    shared=("splits.json",),
)
