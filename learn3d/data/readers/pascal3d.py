"""Pascal3D+ as packed by Kato and Harada 2019 (view prior learning, VPL): real photographs with
approximate 3D models.

- Files are `{aeroplane,car,chair}_{train,val,imagenet}.npz`; training uses train and imagenet. There is no test split:
  both papers report on val, so "test" is val here.
- `images` is an object array of uint8 [H, W, 3], pickled by Python 2, see `files.npz`. The input of the network is the
  object's box, padded by 15 % a side, clipped to the image and stretched to a square. In training
  each side moves by up to 15 % more or less (the augmentation "crop").
- The fourth channel of `images_ref` uint8 [N, 224, 224, 4] is the ground truth silhouette of the crop without that
  augmentation. The published code of Peng et al. 2020 takes every 3.5th pixel of it to get 64x64.
- Cameras are orthographic: v' = R v. VPL's rasterizer turns images upside down AND left-right in the end, so x' points
  LEFT in the image. Here, as everywhere, x' points right: the stored rotation is mirrored once,
  in `poses`.
- VPL adds 1 + 1e-5 to depths and draws from depth 0.1 on, which cuts off z' < -0.9. `RotationPoses` cuts nothing off.
- Objects lie in [-1, 1], upright and mirror-symmetric about z = 0. Voxels are 32^3 over the same box.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from learn3d.data.conventions import LAYOUTS, VOXEL_SIZE, find_splits, synset_of
from learn3d.data.crops import SMALLEST, Crops, bounds
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import RotationPoses
from learn3d.data.view_bins import training_classes
from learn3d.files import npz
from learn3d.files.reading import FAULTS, DamagedFile, FaultHandler, OddFile, attempt, refuse
from learn3d.files.sandbox import Call, read_all

PUBLISHED_SIZE = 224
CATEGORIES = ("aeroplane", "car", "chair")
FILES = {"train": ("train", "imagenet"), "val": ("val",), "test": ("val",)}
CELL_DEG = 45
_CELLS = (360 // CELL_DEG,) * 3
_X_RIGHT = np.diag([-1.0, 1.0, 1.0])
_WANTED = "an npz file of Pascal3D+ as packed by the authors of view prior learning"
_SHAPES = {  # other arrays -> shape of an item
    "images_ref": (PUBLISHED_SIZE, PUBLISHED_SIZE, 4),
    "bounding_boxes": (4,),
    "rotation_matrices": (3, 3),
    "voxels": (VOXEL_SIZE,) * 3,
}
# largest size of a file's rotations; Pascal3D+ has 5,000 photographs
_ROTATION_BYTES = 200_000 * 72


def load(
    folder: Path | str,
    category: str,
    split: str,
    *,
    image_size: int = PUBLISHED_SIZE,
    on_fault: FaultHandler = refuse,
) -> ViewDataset:
    """Read a split ("test" is val); each photograph is an object of its own.

    image_size: side of the network's images in pixels, 224 in both papers. View classes are the
    45-degree cells of the rotation (`rotation_cells`) with training photographs. Another
    photograph gets the class of the training photograph with the nearest rotation; only the MMD
    depends on it.
    """
    paths = _paths(folder, category, split)
    found = read_all([Call(npz.read_ragged, path, ("images", _WANTED), _WANTED)] for path in paths)
    files = [
        attempt(on_fault, _parse, path, result, on_fault)
        for path, (result,) in zip(paths, found, strict=True)
    ]
    if None in files:
        raise DamagedFile(paths[0].parent, f"has no whole {split} split of {category}")
    images = [image for file in files for image in file[0]]
    references, boxes, rotations, voxels = map(np.concatenate, list(zip(*files, strict=True))[1:])
    masks = references[..., 3]
    rotations = rotations.astype(np.float64)
    training = rotations
    if split != "train":
        training = np.concatenate(
            [_training_rotations(path) for path in _paths(folder, category, "train")]
        )
    view_ids, view_names = view_classes(rotations, training)
    crops = Crops.from_images(images, boxes, image_size)
    return ViewDataset(
        **LAYOUTS["pascal3d"].about(category, split),
        images=np.concatenate([crops.cut(), _nearest(masks, image_size)[:, None]], axis=1),
        masks=_nearest(masks, MASK_SIZE),
        poses=poses(rotations),
        view_ids=view_ids,
        view_names=view_names,
        object_ids=np.arange(len(rotations)),
        object_names=tuple(
            f"{path.stem}/{k}"
            for path, file in zip(paths, files, strict=True)
            for k in range(len(file[0]))
        ),
        voxels=voxels,
        crops=crops,
    )


def poses(rotations: np.ndarray) -> RotationPoses:
    """Cameras of stored rotations [M, 3, 3], with x' to the right of the image."""
    return RotationPoses(_X_RIGHT @ np.asarray(rotations, np.float64))


def rotation_cells(rotations: np.ndarray) -> np.ndarray:
    """45-degree cells of the Euler angles about y, then z, then x (scipy's 'yzx'): int64 [M] in 0
    .. 511.

    Angles are first rounded to a thousandth of a degree. Many are 0, the border of two cells, and
    in the published code rounding errors of float32 choose the cell.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = Rotation.from_matrix(rotations).as_euler("yzx", degrees=True)
    cells = np.floor((np.round(angles, 3) + 180) / CELL_DEG).astype(np.int64).clip(0, _CELLS[0] - 1)
    return np.ravel_multi_index(cells.T, _CELLS)


def view_classes(rotations: np.ndarray, training: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Class of each rotation [M, 3, 3], int64 [M] below K, and the K names. Classes are cells of
    `training`.
    """
    # The trace of A^T B grows as the angle between the rotations A and B falls.
    ids, kept = training_classes(
        *((rotation_cells(r), r.reshape(-1, 9)) for r in (rotations, training))
    )
    middle = -180 + CELL_DEG * (np.stack(np.unravel_index(kept, _CELLS), axis=1) + 0.5)
    return ids, tuple(f"y {y:g}°, z {z:g}°, x {x:g}°" for y, z, x in middle)


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder and the splits of each ("test" is val)."""
    found = find_splits(folder, "*_SPLIT.npz").items()
    return {
        name: tuple(s for s in splits if s != "test")
        for name, splits in found
        if name in CATEGORIES
    }


def class_name(category: str) -> str:
    """The name of a category in Pascal3D+, from this name, Kato's name or the synset id;
    ValueError for others.
    """
    for name in CATEGORIES:
        if synset_of(name) == synset_of(category):
            return name
    raise ValueError(f"Pascal3D+ has the categories {', '.join(CATEGORIES)}; got {category!r}")


def _paths(folder: Path | str, category: str, split: str) -> list[Path]:
    if split not in FILES:
        raise ValueError(f"split must be one of {', '.join(FILES)}; got {split!r}")
    return [Path(folder) / f"{class_name(category)}_{part}.npz" for part in FILES[split]]


def _parse(path: Path, images: Any, on_fault: FaultHandler) -> tuple[list[np.ndarray], ...] | None:
    """Check the arrays of a file.

    Returns N images uint8 [H, W, 3] and the arrays of `_SHAPES`; None if one is wrong.

    images: the result of a worker.
    """
    if isinstance(images, FAULTS):
        raise images
    if not len(images):
        raise DamagedFile(path, "it holds no images")
    arrays = []
    for key, shape in _SHAPES.items():
        array = npz.read(path, key, _WANTED, 8 * len(images) * int(np.prod(shape)))
        is_image = key == "images_ref"
        if array.shape != (len(images), *shape) or (is_image and array.dtype != np.uint8):
            wanted = f"{list(shape)} for each of {len(images)} images"
            got = f"{array.dtype} {list(array.shape)}"
            raise DamagedFile(path, f"{key} must be {wanted} (uint8 if images), got {got}")
        arrays.append(array)
    references, boxes, rotations, voxels = arrays
    wrong = [*_wrong_images(images, boxes), *_wrong_rotations(rotations)]
    for message in wrong:
        on_fault(DamagedFile(path, message))
    for k in np.flatnonzero(~(references[..., 3] > 127).any(axis=(1, 2))):
        on_fault(OddFile(path, f"images_ref[{k}] has an empty mask"))
    for k in np.flatnonzero(~voxels.astype(bool).any(axis=(1, 2, 3))):
        on_fault(OddFile(path, f"voxels[{k}] is empty"))
    if wrong:
        return None
    return images, references, boxes, rotations, voxels > 0


def _wrong_images(images: list[np.ndarray], boxes: np.ndarray) -> Iterator[str]:
    """A message for each image of a wrong form, and for each box outside of its image."""
    for k, (image, box) in enumerate(zip(images, boxes, strict=True)):
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
            got = f"{image.dtype} {list(image.shape)}"
            yield f"images[{k}] must be uint8 [H, W, 3], got {got}"
            continue
        is_sound = np.isfinite(box).all() and (box[2:] > 0).all()
        left, top, right, bottom = bounds(box, SMALLEST, image) if is_sound else np.zeros(4)
        if left >= right or top >= bottom:
            wanted = "left, top, width, height within the image"
            yield f"bounding_boxes[{k}] must be {wanted}, got {box}"


def _wrong_rotations(rotations: np.ndarray) -> Iterator[str]:
    """A message for each of the matrices [N, 3, 3] that is no rotation."""
    for k, rotation in enumerate(rotations):
        if not np.isfinite(rotation).all() or np.linalg.det(rotation) <= 0:
            yield f"rotation_matrices[{k}] is no rotation: {rotation.round(3).tolist()}"


def _training_rotations(path: Path) -> np.ndarray:
    """Read only the rotations of a file: float64 [N, 3, 3]."""
    rotations = npz.read(path, "rotation_matrices", _WANTED, _ROTATION_BYTES)
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3):
        raise DamagedFile(path, f"rotation_matrices must be [N, 3, 3], got {list(rotations.shape)}")
    for message in _wrong_rotations(rotations):
        raise DamagedFile(path, message)
    return rotations.astype(np.float64)


def _nearest(masks: np.ndarray, size: int) -> np.ndarray:
    """Resize masks uint8 [M, S, S] by nearest neighbour, as torch's interpolate does."""
    rows = np.arange(size) * masks.shape[1] // size
    return masks[:, rows[:, None], rows]
