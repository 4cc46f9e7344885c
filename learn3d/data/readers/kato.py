"""Kato's data protocol: 24 views per object, 64x64, kept in two npz files per category and split.

The oddities that this module hides (Kato et al. 2018):

- Files are `{synset}_{split}_images.npz`, uint8 [N, 24, 4, 64, 64], and `{synset}_{split}_voxels.npz`, bool
  [N, 32, 32, 32]; each holds the single array 'arr_0'.
- Colours are stored inverted: 255 * (1 - composite over white), so the background is black. Channel 3 is the alpha.
- View k has azimuth -15 k degrees, elevation 30 degrees, distance 2.732, half field of view 15 degrees.
- Voxel axes (1, 2, 3) are (y, x, -z) of the object frame, and the box [-0.5, 0.5] fills cells 0.5 .. 31.5 of the grid.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from learn3d.data.categories import SYNSETS, synset_of
from learn3d.data.conventions import AZIMUTH_STEP_DEG, IMAGE_SIZE, KATO, NUM_VIEWS, VOXEL_SIZE, view_poses
from learn3d.data.dataset import SPLITS, ViewDataset
from learn3d.data.readers.properties import LayoutProperties
from learn3d.data.readers.renderings import check_split
from learn3d.files import npz
from learn3d.files.findings import DamagedFile, Findings, MissingFile, Problem
from learn3d.files.sandbox import Call, read_all

PROPERTIES = LayoutProperties(voxels=True, convention=KATO, inverted=True)
VIEW_NAMES = tuple(f"azimuth {AZIMUTH_STEP_DEG * view:g}°" for view in range(NUM_VIEWS))

_KEY = "arr_0"
_ARRAYS = {  # dtype and shape of one object
    "images": (np.dtype(np.uint8), (NUM_VIEWS, 4, IMAGE_SIZE, IMAGE_SIZE)),
    "voxels": (np.dtype(np.bool_), (VOXEL_SIZE,) * 3),
}


def split_paths(folder: Path | str, category: str, split: str) -> tuple[Path, Path]:
    """Paths of the images file and of the voxels file of one category and split."""
    stem = f"{synset_of(category)}_{split}"
    return Path(folder) / f"{stem}_images.npz", Path(folder) / f"{stem}_voxels.npz"


def load(folder: Path | str, category: str, split: str) -> ViewDataset:
    """Read and check one category (name or synset id) and split ("train", "val" or "test") of a folder.

    Sample `object * 24 + view` is one view of one object; the pose classes are the 24 views.
    Raises FileNotFoundError where a file is missing (the message lists what the folder holds) and ValueError where
    a file is no such npz, or its array has another shape or dtype, or the two files disagree on the object count.
    """
    check_split(split)
    images, voxels = _read(folder, category, split, Findings(strict=True))
    return from_arrays(images, voxels, category, split)


def from_arrays(images: np.ndarray, voxels: np.ndarray, category: str, split: str) -> ViewDataset:
    """The data set of images uint8 [N, 24, 4, 64, 64] and voxels bool [N, 32, 32, 32], as the files hold them."""
    count = len(images)
    view_ids = np.tile(np.arange(NUM_VIEWS), count)
    return ViewDataset(
        category=category,
        split=split,
        images=images.reshape(count * NUM_VIEWS, 4, IMAGE_SIZE, IMAGE_SIZE),
        poses=view_poses(torch.from_numpy(view_ids)),
        view_ids=view_ids,
        view_names=VIEW_NAMES,
        object_ids=np.repeat(np.arange(count), NUM_VIEWS),
        object_names=tuple(f"{i:04d}" for i in range(count)),
        voxels=voxels,
        convention=KATO,
    )


def problems(folder: Path | str, category: str, split: str, *, progress: bool = False) -> Iterator[Problem]:
    """Everything that is wrong with the two files of one category and split."""
    findings = Findings()
    arrays = _read(folder, category, split, findings)
    yield from findings.problems
    for path, kind, array in zip(split_paths(folder, category, split), _ARRAYS, arrays, strict=True):
        if array is None:
            continue
        empty = array[:, :, 3].max((2, 3)) < 128 if kind == "images" else ~array.any((1, 2, 3))
        for index in np.argwhere(empty).tolist():
            what = "the mask of object {}, view {}," if kind == "images" else "the grid of object {}"
            yield Problem(str(path), f"{what.format(*index)} is empty", "warning")


def contents(folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories (synset ids or prefixes) of a folder and the splits of each, by the names of its files."""
    found: dict[str, set[str]] = {}
    for kind in _ARRAYS:
        for path in Path(folder).glob(f"*_{kind}.npz"):
            prefix, _, split = path.name.removesuffix(f"_{kind}.npz").rpartition("_")
            if prefix and split in SPLITS:
                found.setdefault(prefix, set()).add(split)
    return {prefix: tuple(s for s in SPLITS if s in splits) for prefix, splits in sorted(found.items())}


def count(folder: Path | str, category: str, split: str) -> int:
    """How many objects a split holds, from the header of its voxels (or images) file alone; 0 where it has none."""
    heads = _headers(split_paths(folder, category, split))
    with contextlib.suppress(StopIteration, IndexError):
        return next(head.shape[0] for head in reversed(heads) if isinstance(head, npz.Header))
    return 0


def _read(folder: Path | str, category: str, split: str, findings: Findings) -> list[np.ndarray | None]:
    """Images [N, 24, 4, 64, 64] and voxels [N, 32, 32, 32], read at the same time; None for what findings tell of."""
    paths = split_paths(folder, category, split)
    for path in paths:
        findings.attempt(_check_there, path, category, split)
    heads = [
        findings.attempt(_checked, path, kind, head) if path.is_file() else None
        for path, kind, head in zip(paths, _ARRAYS, _headers(paths), strict=True)
    ]
    counts = [head.shape[0] for head in heads if head is not None]
    if len(counts) == 2:
        findings.attempt(_check_counts, paths, *counts)
    calls = []
    for path, (kind, (dtype, shape)), head in zip(paths, _ARRAYS.items(), heads, strict=True):
        # Grids are mostly zeros, and no expansion would be suspect: they are as many as the images.
        most = counts[0] * math.prod(shape) * dtype.itemsize if kind == "voxels" and len(counts) == 2 else None
        calls += [[Call(npz.read, path, (_KEY, most), _wanted(kind))]] if head is not None else []
    arrays = iter(findings.take(array) for (array,) in read_all(calls))
    return [None if head is None else next(arrays) for head in heads]


def _headers(paths: tuple[Path, Path]) -> list[Any]:
    """The header of the array of each file, or what is wrong with it."""
    calls = [[Call(npz.header, path, (_KEY,), _wanted(kind))] for path, kind in zip(paths, _ARRAYS, strict=True)]
    return [head for (head,) in read_all(calls)]


def _wanted(kind: str) -> str:
    dtype, shape = _ARRAYS[kind]
    text = f"{dtype} [N, {', '.join(map(str, shape))}] under the key '{_KEY}'"
    return f"an npz file with {text} and no pickled objects"


def _checked(path: Path, kind: str, head: Any) -> npz.Header:
    if not isinstance(head, npz.Header):
        raise head
    if (head.dtype, head.shape[1:]) != _ARRAYS[kind] or not head.shape:
        raise DamagedFile(path, f"the {kind} file must be {_wanted(kind)}, got {head}")
    return head


def _check_there(path: Path, category: str, split: str) -> None:
    if not path.is_file():
        raise MissingFile(path, _what_is_there(category, split, path))


def _check_counts(paths: tuple[Path, Path], images: int, voxels: int) -> None:
    if images != voxels:
        raise DamagedFile(
            paths[0],
            f"holds {images} objects but {paths[1].name} holds {voxels}; "
            "the two files must come from the same data set: fetch or make both again",
        )
    if images == 0:
        raise DamagedFile(paths[0], "holds no object; make the data set with more meshes or another split")


def _what_is_there(category: str, split: str, missing: Path) -> str:
    """Message for a missing file: what was wanted, what the folder holds, what to do."""
    folder = missing.parent
    wanted = f"is missing ({category}, {split})"
    if not folder.is_dir():
        return f"{wanted}: there is no such folder; give the one with the npz files, or make it (learn3d make-dataset)"
    pair = split_paths(folder, category, split)
    for other, kind, lacking in zip(pair, _ARRAYS, reversed(_ARRAYS), strict=True):
        if other.is_file():
            return (
                f"{wanted}: the {kind} are there ({other.name}), but a split needs the {lacking}, too. Fetch or copy "
                "that file from where the other came from, or make both again (learn3d make-dataset --overwrite)"
            )
    names = {synset: name for name, synset in SYNSETS.items()}
    found = []
    for prefix, splits in contents(folder).items():
        whole = [s for s in splits if all(path.is_file() for path in split_paths(folder, prefix, s))]
        found += [f"{names.get(prefix, prefix)} {s}" for s in whole]
    if found:
        return f"{wanted}; the folder holds: {', '.join(found)}. Choose one of these, or make it (learn3d make-dataset)"
    return (
        f"{wanted}; the folder holds no '*_images.npz' with its '*_voxels.npz' at all. Give another folder, or make "
        "one (learn3d make-dataset)"
    )
