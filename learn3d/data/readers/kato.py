"""Kato's layout (Kato et al. 2018): 24 views of each object, in two npz files per split.

- Files are `{synset}_{split}_images.npz`, uint8 [N, 24, 4, 64, 64], and `{synset}_{split}_voxels.npz`, bool
  [N, 32, 32, 32]; each holds the single array 'arr_0'.
- Colours are stored inverted: 255 * (1 - composite over white), so the background is black. Channel 3 is the alpha.
- View k has azimuth -15 k degrees, elevation 30 degrees, distance 2.732, half field of view 15 degrees.
- Voxel axes (1, 2, 3) are (y, x, -z) of the object frame, and the box [-0.5, 0.5] fills cells 0.5 .. 31.5 of the grid.
"""

import math
from pathlib import Path

import numpy as np
import torch

from learn3d.data.conventions import (
    AZIMUTH_STEP_DEG,
    IMAGE_SIZE,
    LAYOUTS,
    NUM_VIEWS,
    SYNSETS,
    VOXEL_SIZE,
    find_splits,
    synset_of,
    view_poses,
)
from learn3d.data.dataset import ViewDataset
from learn3d.files import npz
from learn3d.files.reading import DamagedFile, FaultHandler, MissingFile, OddFile, attempt, refuse

_KEY = "arr_0"
_ARRAYS = {  # dtype and shape of one object
    "images": (np.dtype(np.uint8), (NUM_VIEWS, 4, IMAGE_SIZE, IMAGE_SIZE)),
    "voxels": (np.dtype(np.bool_), (VOXEL_SIZE,) * 3),
}


def split_paths(folder: Path | str, category: str, split: str) -> tuple[Path, Path]:
    """Paths of the images file and of the voxels file of one category and split."""
    stem = f"{synset_of(category)}_{split}"
    return Path(folder) / f"{stem}_images.npz", Path(folder) / f"{stem}_voxels.npz"


def load(
    folder: Path | str, category: str, split: str, *, on_fault: FaultHandler = refuse
) -> ViewDataset:
    """Read a split.

    Sample `object * 24 + view` is one view of one object; the view classes are the 24 views.
    """
    paths = split_paths(folder, category, split)
    images = attempt(on_fault, _read, paths[0], "images", None)
    # Grids are mostly zeros, so their compression ratio is no sign of a zip bomb: the number of images bounds them.
    voxels = attempt(on_fault, _read, paths[1], "voxels", None if images is None else len(images))
    if images is None or voxels is None or len(images) != len(voxels) or not len(images):
        counts = [0 if array is None else len(array) for array in (images, voxels)]
        found = f"holds {counts[0]} objects and {paths[1].name} {counts[1]}"
        wanted = "expected equal numbers above 0: fetch or make both again"
        raise DamagedFile(paths[0], f"{found}; {wanted}")
    for index, view in np.argwhere(images[:, :, 3].max((2, 3)) < 128):
        on_fault(OddFile(paths[0], f"the mask of object {index}, view {view}, is empty"))
    for index in np.flatnonzero(~voxels.any((1, 2, 3))):
        on_fault(OddFile(paths[1], f"the grid of object {index} is empty"))
    return from_arrays(images, voxels, category, split)


def from_arrays(
    images: np.ndarray, voxels: np.ndarray | None, category: str, split: str
) -> ViewDataset:
    """The data set of images uint8 [N, 24, 4, 64, 64] and voxels bool [N, 32, 32, 32]."""
    images = images.reshape(-1, 4, IMAGE_SIZE, IMAGE_SIZE)
    count = len(images) // NUM_VIEWS
    view_ids = np.tile(np.arange(NUM_VIEWS), count)
    return ViewDataset(
        **LAYOUTS["kato"].about(category, split),
        images=images,
        poses=view_poses(torch.from_numpy(view_ids)),
        view_ids=view_ids,
        view_names=tuple(f"azimuth {AZIMUTH_STEP_DEG * view:g}°" for view in range(NUM_VIEWS)),
        object_ids=np.repeat(np.arange(count), NUM_VIEWS),
        object_names=tuple(f"{i:04d}" for i in range(count)),
        voxels=voxels,
    )


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories (synset ids or prefixes) of a folder and their splits, by file names."""
    return find_splits(folder, *(f"*_SPLIT_{kind}.npz" for kind in _ARRAYS))


def _read(path: Path, kind: str, count: int | None) -> np.ndarray:
    """The array of one file. count: largest number of objects; None if unknown."""
    if not path.is_file():
        names = {synset: name for name, synset in SYNSETS.items()}
        there = [
            f"{names.get(prefix, prefix)} {s}"
            for prefix, splits in contents(path.parent).items()
            for s in splits
        ]
        missing = "is missing: a split is two files, *_images.npz and *_voxels.npz."
        choice = f"The folder holds: {', '.join(there)}. Choose one of these, or make it"
        advice = choice if there else "The folder holds no split. Make one"
        raise MissingFile(path, f"{missing} {advice} (learn3d make-dataset)")
    dtype, shape = _ARRAYS[kind]
    wanted = f"an npz file with {dtype} [N, {', '.join(map(str, shape))}] under the key '{_KEY}' and no pickled objects"
    max_bytes = None if count is None else count * math.prod(shape) * dtype.itemsize
    array = npz.read(path, _KEY, wanted, max_bytes)
    if (array.dtype, array.shape[1:]) != (dtype, shape) or not array.shape:
        raise DamagedFile(
            path, f"the {kind} file must be {wanted}, got {array.dtype} {list(array.shape)}"
        )
    return array
