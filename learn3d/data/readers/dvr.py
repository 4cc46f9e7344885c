"""The NMR_Dataset of DVR (Niemeyer et al. 2020): Kato's renderings as one folder per object.

- `{synset}/{id}/image/0000.png` .. `0023.png`, 64x64, objects on white; `{synset}/{id}/mask/0000.png` ..: the alpha.
- `{synset}/{id}/cameras.npz`: `world_mat_0` .. `world_mat_23`, 4x4, world to camera with x right and the object in
  front. The focal length is that of Kato's cameras; `camera_mat_k` is not read.
- `{synset}/{id}/pointcloud.npz`: `points` [P, 3] on the surface in the world of the cameras.
- `{synset}/softras_{train,val,test}.lst`: one id per line.

The data set has the content of Kato's npz files, and exactly Kato's cameras. A fit of the 24
camera positions finds the rotation (and reflection) from the file's world to the object frame,
which is also applied to the points. A file with another order, direction or distance of its views
is refused.

There are no voxels: measure with the points (Chamfer distance, F-score). Kato's voxels are not
used, because their objects may have another order than the lists.
"""

import dataclasses
from pathlib import Path

import numpy as np
import torch

from learn3d.data.conventions import (
    IMAGE_SIZE,
    NUM_VIEWS,
    SPLITS,
    find_splits,
    synset_of,
    view_poses,
)
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import kato
from learn3d.data.readers.objects import Files, check_lists, read_objects
from learn3d.files import images, limits, npz
from learn3d.files.reading import DamagedFile, FaultHandler, MissingFile, read_text, refuse
from learn3d.files.sandbox import Call

POINTS = 10_000  # points that are kept of each object's 100,000, which are in random order
_EYE_TOLERANCE = 0.01  # largest error of a camera position, in units of the object frame
# least cosine of the angle between an image axis or a viewing direction and Kato's
_MIN_COSINE = 0.9995
_MATRICES = [f"world_mat_{k}" for k in range(NUM_VIEWS)]
_CAMERAS = "an npz file with world_mat_0 .. world_mat_23, 4x4, from the world to Kato's 24 cameras"
_CLOUD = "an npz file with the array 'points' [P, 3]: finite, within the unit cube"


def load(
    folder: Path | str, category: str, split: str, *, on_fault: FaultHandler = refuse
) -> ViewDataset:
    """Read a split; the view classes are Kato's 24 views."""
    root = _category_folder(Path(folder), category)
    paths = {s: path for s in SPLITS if (path := root / f"softras_{s}.lst").is_file()}
    path = root / f"softras_{split}.lst"
    if split not in paths:
        there = ", ".join(paths) or "none"
        raise MissingFile(path, f"is missing; expected a list of ids. Splits here: {there}")
    lists = {
        s: read_text(path, limits.TEXT_BYTES, "a list of ids").split() for s, path in paths.items()
    }
    ids = check_lists(path, lists, split, on_fault)

    def files(name: str) -> Files:
        of = root / name
        pairs = [
            (of / "image" / f"{k:04d}.png", of / "mask" / f"{k:04d}.png") for k in range(NUM_VIEWS)
        ]
        return Files(
            Call(npz.read_several, of / "cameras.npz", (_MATRICES, _CAMERAS, 16 * 8)),
            Call(npz.read, of / "pointcloud.npz", ("points", _CLOUD, limits.OBJECT_BYTES)),
            [Call(images.read_with_mask, image, (mask, IMAGE_SIZE)) for image, mask in pairs],
        )

    objects = read_objects(ids, files, _build, IMAGE_SIZE, on_fault, f"{category} {split}")
    clouds = objects.shapes
    points = np.stack([cloud[: min(map(len, clouds))] for cloud in clouds])
    dataset = kato.from_arrays(objects.images, None, category, split)
    return dataclasses.replace(dataset, object_names=tuple(objects.names), points=points)


def _category_folder(folder: Path, category: str) -> Path:
    """The folder of a category (name or synset id) in `folder`.

    Raises MissingFile with the existing ones.
    """
    path = folder / synset_of(category)
    if not path.is_dir():
        there = ", ".join(sorted(p.name for p in folder.glob("*/"))) or "none"
        raise MissingFile(path, f"there is no folder of {category!r}; those here are: {there}")
    return path


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories (synset ids) of a folder and the splits of each."""
    return find_splits(folder, "*/softras_SPLIT.lst")


def _build(files: Files, cameras: list[np.ndarray], points: np.ndarray) -> tuple[None, np.ndarray]:
    to_object = _fit_world(files.cameras.path, cameras)
    cloud = files.shape.path
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise DamagedFile(cloud, f"has the shape {list(points.shape)}; expected {_CLOUD}")
    points = points[:POINTS].astype(np.float64)
    if not np.abs(points).max() < 1:
        farthest = np.abs(points).max()
        raise DamagedFile(cloud, f"has coordinates up to {farthest:.3g}; expected {_CLOUD}")
    return None, (points @ to_object.T).astype(np.float32)


def _fit_world(path: Path, cameras: list[np.ndarray]) -> np.ndarray:
    """Orthogonal matrix [3, 3] from the cameras' world to the object frame.

    DamagedFile if they are not Kato's.
    """
    for name, matrix in zip(_MATRICES, cameras, strict=True):
        if matrix.shape != (4, 4):
            raise DamagedFile(path, f"has no {name} of 4x4 numbers; expected {_CAMERAS}")
    matrices = np.stack(cameras)[:, :3].astype(np.float64)
    rotations = matrices[:, :, :3]
    skew = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    if not (skew <= 1e-3).all() or not np.isfinite(matrices).all():
        raise DamagedFile(
            path,
            f"the left 3x3 part of a matrix is no rotation, or not finite; expected {_CAMERAS}",
        )
    eyes = -np.einsum("kij,ki->kj", rotations, matrices[:, :, 3])
    poses = view_poses(torch.arange(NUM_VIEWS))
    true_eyes = poses.eyes().double().numpy()
    u, _, v = np.linalg.svd(true_eyes.T @ eyes)
    to_object = u @ v
    # rows: right, down, forward
    true_rotations = poses.cameras().projection().matrix[:, :, :3].numpy()
    cosines = (rotations @ to_object.T * true_rotations).sum(axis=2)[:, [0, 2]].min(axis=1)
    off = np.linalg.norm(eyes @ to_object.T - true_eyes, axis=1)
    fault = np.maximum(off / _EYE_TOLERANCE, (1 - cosines) / (1 - _MIN_COSINE))
    if fault.max() > 1:
        raise DamagedFile(
            path,
            f"the camera of view {fault.argmax()} is not Kato's (distance 2.732, elevation 30, azimuth -15 degrees per "
            "view, neither rolled nor mirrored); other views are not read",
        )
    return to_object
