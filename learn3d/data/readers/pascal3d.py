"""Pascal3D+ as packed by Kato and Harada 2019 (view prior learning, VPL): real photographs with approximate 3D models.

The oddities that this module hides:

- Files are `{aeroplane,car,chair}_{train,val,imagenet}.npz`; training uses train and imagenet. There is no test split:
  both papers report on val, and so "test" is val here.
- `images` is an object array of uint8 [H, W, 3], pickled by Python 2: see `files.npz`. The network sees the object's
  box, padded by 15 % a side, clipped to the image and stretched to a square; in training each side moves by up to 15 %
  more or less (the augmentation "crop").
- `images_ref` uint8 [N, 224, 224, 4] is the crop whose fourth channel is the silhouette to be matched; it never moves.
  The published code of Peng et al. 2020 takes every 3.5th pixel of it to get 64x64.
- Cameras are orthographic: v' = R v. VPL's rasterizer turns images upside down AND left-right in the end, so x' points
  LEFT in the image. Here, as everywhere, x' points right: the stored rotation is mirrored once, in `poses`.
- VPL moves depths by 1 + 1e-5 and draws from 0.1 on, so that z' < -0.9 is cut off; `RotationPoses` draws all that VPL
  draws, and what lies in front of that, too.
- Objects lie in [-1, 1], upright and mirror-symmetric about z = 0. Voxels are 32^3 over the same box.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from learn3d.data.conventions import VOXEL_SIZE, VoxelConvention
from learn3d.data.crops import SMALLEST, Crops, bounds
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import RotationPoses
from learn3d.data.readers.properties import LayoutProperties
from learn3d.data.readers.renderings import check_split
from learn3d.files import npz
from learn3d.files.findings import DamagedFile, Findings, MissingFile, Problem
from learn3d.files.sandbox import Call, read_all

#: The grid spans [-1, 1]; axes (-x, -z, -y) of the object frame.
PASCAL3D = VoxelConvention("pascal3d", swap=(2, 3), flip=(1, 2, 3), box=2.0)
PROPERTIES = LayoutProperties(
    voxels=True, convention=PASCAL3D, inverted=False, angles=False, stretched=True, options=("image_size",)
)
IMAGE_SIZE = 224
CATEGORIES = ("aeroplane", "car", "chair")
FILES = {"train": ("train", "imagenet"), "val": ("val",), "test": ("val",)}
CELL_DEG = 45
_CELLS = 360 // CELL_DEG
_OTHER_NAMES = {"airplane": "aeroplane", "02691156": "aeroplane", "02958343": "car", "03001627": "chair"}
_X_RIGHT = np.diag([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class _File:
    """The contents of one npz file."""

    path: Path
    images: list[np.ndarray]  # N, uint8 [H, W, 3]
    references: np.ndarray  # uint8 [N, 224, 224, 4]
    boxes: np.ndarray  # float64 [N, 4]
    rotations: np.ndarray  # float64 [N, 3, 3]
    voxels: np.ndarray  # bool [N, 32, 32, 32]


def load(folder: Path | str, category: str, split: str, *, image_size: int = IMAGE_SIZE) -> ViewDataset:
    """Read one split ("train", "val" or "test", which is val) of one category: each photograph is an object of its own.

    image_size: side of the network's images, 224 in both papers. View classes are the 45-degree cells of the rotation
    (`rotation_cells`) that occur in training; a photograph of the val files that falls into another cell gets the class
    of the training photograph with the nearest rotation. Only the MMD depends on it.

    Raises FileNotFoundError for a missing file and ValueError for a damaged one, both named.
    """
    check_split(split)
    paths = _paths(folder, category, split)
    training_paths = () if split == "train" else _paths(folder, category, "train")
    found = list(read_all([*([_call(path)] for path in paths), *([_rotations(path)] for path in training_paths)]))
    files = [_file(path, arrays) for path, (arrays,) in zip(paths, found, strict=False)]
    for file in files:
        if problem := next(_severe_problems(file), None):
            raise DamagedFile(file.path, problem)
    rotations = np.concatenate([file.rotations for file in files])
    training = rotations
    if split != "train":
        rest = zip(training_paths, found[len(paths) :], strict=True)
        training = np.concatenate([_checked_rotations(path, array) for path, (array,) in rest])
    view_ids, view_names = view_classes(rotations, training)
    boxes = np.concatenate([file.boxes for file in files])
    crops = Crops.from_images([image for file in files for image in file.images], boxes, image_size)
    references = np.concatenate([file.references[..., 3] for file in files])
    images = np.concatenate([crops.cut(), _nearest(references, image_size)[:, None]], axis=1)
    return ViewDataset(
        category=category,
        split=split,
        images=images,
        masks=_nearest(references, MASK_SIZE),
        poses=poses(rotations),
        view_ids=view_ids,
        view_names=view_names,
        object_ids=np.arange(len(images)),
        object_names=tuple(f"{file.path.stem}/{k}" for file in files for k in range(len(file.images))),
        voxels=np.concatenate([file.voxels for file in files]),
        convention=PASCAL3D,
        inverted=False,
        crops=crops,
    )


def poses(rotations: np.ndarray) -> RotationPoses:
    """Cameras of stored rotations [M, 3, 3], with x' to the right of the image."""
    return RotationPoses(_X_RIGHT @ np.asarray(rotations, np.float64))


def rotation_cells(rotations: np.ndarray) -> np.ndarray:
    """45-degree cells of the Euler angles about y, then z, then x (scipy's 'yzx'), int64 [M] in 0 .. 511.

    Angles are rounded to a thousandth of a degree first: many are 0, which is where two cells meet, and the noise of
    float32 would choose between them in the published code.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = Rotation.from_matrix(rotations).as_euler("yzx", degrees=True)
    cells = np.floor((np.round(angles, 3) + 180) / CELL_DEG).astype(np.int64).clip(0, _CELLS - 1)
    return (cells[:, 0] * _CELLS + cells[:, 1]) * _CELLS + cells[:, 2]


def view_classes(rotations: np.ndarray, training: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Class int64 [M] in 0 .. K-1 of each rotation and the K names: the cells that `training` [T, 3, 3] occupies."""
    training_cells, cells = rotation_cells(training), rotation_cells(rotations)
    kept = np.unique(training_cells)
    unseen = ~np.isin(cells, kept)
    # The trace of A^T B grows as the angle between the rotations A and B falls.
    nearest = (rotations[unseen].reshape(-1, 9) @ training.reshape(-1, 9).T).argmax(axis=1)
    cells[unseen] = training_cells[nearest]
    middle = [[-180 + CELL_DEG * (c // _CELLS**k % _CELLS + 0.5) for k in (2, 1, 0)] for c in kept]
    return np.searchsorted(kept, cells), tuple(f"y {y:g}°, z {z:g}°, x {x:g}°" for y, z, x in middle)


def problems(folder: Path | str, category: str, split: str, *, progress: bool = False) -> Iterator[Problem]:
    """Everything that is wrong with the files of one split."""
    for path in tqdm(_paths(folder, category, split), desc=f"{category} {split}", disable=not progress):
        try:
            ((found,),) = read_all([[_call(path)]])
            file = _file(path, found)
        except (DamagedFile, MissingFile) as error:
            yield Problem(str(path), error.message)
            continue
        yield from (Problem(str(path), text) for text in _severe_problems(file))
        yield from (Problem(str(path), text, "warning") for text in _slight_problems(file))


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder and the splits of each ("test" is val)."""
    found = {
        name: [s for s in ("train", "val") if any(p.exists() for p in _paths(folder, name, s))] for name in CATEGORIES
    }
    return {name: tuple(splits) for name, splits in found.items() if splits}


def count(folder: Path | str, category: str, split: str) -> int:
    """How many photographs a split has, each an object of its own."""
    paths = _paths(folder, category, split)
    found = read_all([_rotations(path)] for path in paths)
    return sum(len(_checked_rotations(path, array)) for path, (array,) in zip(paths, found, strict=True))


def _paths(folder: Path | str, category: str, split: str) -> list[Path]:
    return [Path(folder) / f"{class_name(category)}_{part}.npz" for part in FILES[split]]


def class_name(category: str) -> str:
    """What Pascal3D+ calls a category, which may also be one of Kato's names or a synset id; ValueError for others."""
    name = _OTHER_NAMES.get(category, category)
    if name not in CATEGORIES:
        raise ValueError(f"Pascal3D+ has the categories {', '.join(CATEGORIES)}; got {category!r}")
    return name


_ITEM_BYTES = {  # the most bytes of one item
    "images_ref": 4 * IMAGE_SIZE**2,
    "bounding_boxes": 4 * 8,
    "rotation_matrices": 9 * 8,
    "voxels": 8 * VOXEL_SIZE**3,
}
_PHOTOGRAPHS = 200_000  # of a file; Pascal3D+ has 5,000
_WANTED = "an npz file of Pascal3D+ as packed by the authors of view prior learning"


def _call(path: Path) -> Call:
    return Call(npz.read_with_items, path, ("images", _ITEM_BYTES), _WANTED)


def _rotations(path: Path) -> Call:
    return Call(npz.read, path, ("rotation_matrices", _PHOTOGRAPHS * _ITEM_BYTES["rotation_matrices"]), _WANTED)


def _file(path: Path, found: Any) -> _File:
    """A file of the result of `_call`; DamagedFile and MissingFile where its arrays do not go together."""
    images, references, boxes, rotations, voxels = _taken(path, found)
    if isinstance(images, np.ndarray):  # if all have one size, they are one array
        if images.ndim != 4:
            raise DamagedFile(path, f"images must be uint8 [H, W, 3] each, got one array {list(images.shape)}")
        images = list(images)
    else:
        flat, shapes = images
        ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
        images = [flat[end - math.prod(shape) : end].reshape(shape) for end, shape in zip(ends, shapes, strict=True)]
    count = len(images)
    _check_shape(path, "images_ref", references, (count, IMAGE_SIZE, IMAGE_SIZE, 4), np.uint8)
    _check_shape(path, "bounding_boxes", boxes, (count, 4))
    _check_shape(path, "rotation_matrices", rotations, (count, 3, 3))
    _check_shape(path, "voxels", voxels, (count, *(VOXEL_SIZE,) * 3))
    if count == 0:
        raise DamagedFile(path, "it holds no images")
    return _File(path, images, references, boxes.astype(np.float64), rotations.astype(np.float64), voxels > 0)


def _checked_rotations(path: Path, found: Any) -> np.ndarray:
    """The rotations alone, float64 [N, 3, 3]."""
    rotations = _taken(path, found)
    _check_shape(path, "rotation_matrices", rotations, (len(rotations) if rotations.ndim else 0, 3, 3))
    for text in _rotation_problems(rotations):
        raise DamagedFile(path, text)
    return rotations.astype(np.float64)


def _taken(path: Path, found: Any) -> Any:
    """A result of a worker; what is missing is said with what the folder has."""
    if isinstance(found, MissingFile):
        there = ", ".join(sorted(p.name for p in path.parent.glob("*.npz"))) or "no npz file"
        name = path.stem.split("_")[0]
        raise MissingFile(
            path,
            f"is missing; its folder has {there}. Pascal3D+ is {name}_train.npz, {name}_imagenet.npz and "
            f"{name}_val.npz, as packed by the authors of view prior learning",
        )
    return Findings(strict=True).take(found)


def _check_shape(path: Path, key: str, array: np.ndarray, shape: tuple[int, ...], dtype: type | None = None) -> None:
    if array.shape != shape or (dtype is not None and array.dtype != dtype):
        wanted, got = f"{np.dtype(dtype)} " if dtype else "", f"{array.dtype} {list(array.shape)}"
        raise DamagedFile(path, f"{key} must be {wanted}{list(shape)} (as many as there are images), got {got}")


def _severe_problems(file: _File) -> Iterator[str]:
    """What makes a file unusable."""
    for k, image in enumerate(file.images):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
            yield f"images[{k}] must be uint8 [H, W, 3], got {image.dtype} {list(image.shape)}"
            continue
        height, width = image.shape[:2]
        if not np.isfinite(file.boxes[k]).all() or (file.boxes[k, 2:] <= 0).any():
            yield f"bounding_boxes[{k}] must be left, top, width, height with a positive size, got {file.boxes[k]}"
            continue
        left, top, right, bottom = bounds(file.boxes[k], SMALLEST, width, height)
        if left >= right or top >= bottom:
            yield f"bounding_boxes[{k}] = {file.boxes[k]} has no pixel in its image of {width}x{height}"
    yield from _rotation_problems(file.rotations)


def _rotation_problems(rotations: np.ndarray) -> Iterator[str]:
    for k, rotation in enumerate(rotations):
        if not np.isfinite(rotation).all() or np.linalg.det(rotation) <= 0:
            yield f"rotation_matrices[{k}] is no rotation: its numbers are {rotation.round(3).tolist()}"


def _slight_problems(file: _File) -> Iterator[str]:
    """What can be trained with, but should not be there."""
    for k, rotation in enumerate(file.rotations):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error > 1e-3:
            yield f"rotation_matrices[{k}] is {error:.3f} from being orthonormal"
    for k in np.flatnonzero(~(file.references[..., 3] > 127).any(axis=(1, 2))):
        yield f"images_ref[{k}] has an empty mask"
    for k in np.flatnonzero(~file.voxels.any(axis=(1, 2, 3))):
        yield f"voxels[{k}] is empty"


def _nearest(masks: np.ndarray, size: int) -> np.ndarray:
    """Masks uint8 [M, S, S] at another size, pixel by pixel, as torch.nn.functional.interpolate does by default."""
    rows = np.arange(size) * masks.shape[1] // size
    return masks[:, rows[:, None], rows]
