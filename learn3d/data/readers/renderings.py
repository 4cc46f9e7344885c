"""Shared functions of the readers kar, r2n2 and dvr: read the files of many objects, and join them to arrays."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from learn3d.data.categories import synset_of
from learn3d.data.conventions import VoxelConvention
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.view_bins import AngleBins
from learn3d.files import limits
from learn3d.files.reading import DamagedFile, Findings, MissingFile
from learn3d.files.sandbox import Call, read_all


class ObjectFiles(NamedTuple):
    """The files of one object, as calls of the sandbox."""

    folder: Path  # it must exist
    cameras: Call
    shape: Call  # voxels or points
    views: list[Call]  # each returns an image uint8 [4, S, S], a mask uint8 [64, 64] and the mask's largest value


class Objects(NamedTuple):
    """N objects of V views each, as arrays."""

    images: np.ndarray  # uint8 [N * V, 4, S, S]
    masks: np.ndarray | None  # uint8 [N * V, 64, 64]; None: the images' fourth channel
    poses: list[np.ndarray]  # N first results of `build`
    shapes: list[np.ndarray]  # N second results of `build`


def read_objects(
    names: Sequence[str],
    files: Callable[[str], ObjectFiles],
    build: Callable[[ObjectFiles, Any, Any], tuple[Any, np.ndarray]],
    image_size: int,
    findings: Findings,
    progress: str = "",
) -> Objects | None:
    """Read the objects `names`, all with the same number of views. Returns None if the findings are not strict.

    build: returns the poses and the shape of an object from the results of its calls `cameras` and `shape`, or raises
    DamagedFile. progress: title of a progress bar; "" for none.
    """
    findings.objects, asked = len(names), deque()

    def calls() -> Iterator[list[Call]]:
        for each in map(files, names):
            if findings.attempt(_check_folder, each.folder):
                asked.append(each)
                yield [each.cameras, each.shape, *each.views]

    read = tqdm(read_all(calls()), progress, len(names), disable=not progress, unit="object")
    count = len(names) * len(files(names[0]).views) if findings.strict else 0
    images, masks = (np.empty((count, *shape), np.uint8) for shape in ((4, image_size, image_size), (MASK_SIZE,) * 2))
    poses, shapes, row = [], [], 0
    for cameras, shape, *views in read:
        each = asked.popleft()
        cameras, shape = findings.take(cameras), findings.take(shape)
        if cameras is not None and shape is not None and (built := findings.attempt(build, each, cameras, shape)):
            if not built[1].any():
                findings.warn(each.shape.path, "the grid is empty")
            poses.append(built[0])
            shapes.append(built[1])
        for call, view in zip(each.views, views, strict=True):
            if findings.take(view) is None:
                continue
            if view[2] < 128:
                findings.warn(call.path, f"its mask is empty: the brightest of its values 0 .. 255 is {view[2]}")
            if findings.strict:
                images[row], masks[row] = view[:2]
                row += 1
    return Objects(images, None if image_size == MASK_SIZE else masks, poses, shapes) if findings.strict else None


def _check_folder(path: Path) -> bool:
    if not path.is_dir():
        raise MissingFile(path, "is missing; expected the folder of an object")
    return True


def join_objects(
    objects: Objects | None,
    names: Sequence[str],
    category: str,
    split: str,
    half_fov_deg: float,
    view_bins: str,
    convention: VoxelConvention,
) -> ViewDataset | None:
    """The data set of objects with voxels and look-at poses; None if objects is None. Colours are not inverted.

    view_bins: cells of the view classes, see `AngleBins.parse`.
    """
    if objects is None:
        return None
    poses = LookAtPoses(*np.concatenate(objects.poses).T, half_fov_deg)
    bins = AngleBins.parse(view_bins)
    return ViewDataset(
        category=category,
        split=split,
        images=objects.images,
        poses=poses,
        view_ids=bins.ids(poses).numpy(),
        view_names=tuple(bins.names()),
        object_ids=np.repeat(np.arange(len(names)), [len(each) for each in objects.poses]),
        object_names=tuple(names),
        voxels=np.stack(objects.shapes),
        convention=convention,
        masks=objects.masks,
        inverted=False,
    )


def check_poses(path: Path, poses: np.ndarray, wanted: str) -> np.ndarray:
    """Return poses float64 [V, 3] (azimuth, elevation, distance). Raises DamagedFile if one is out of range."""
    sound = LookAtPoses(*torch.from_numpy(poses.T), 15.0).in_range().numpy()
    if not sound.all():
        k = int(sound.argmin())
        azimuth, elevation, distance = poses[k]
        found = f"azimuth {azimuth:g}, elevation {elevation:g} and distance {distance:g}"
        raise DamagedFile(path, f"row {k} has {found}; expected {wanted}")
    return poses


def category_folder(folder: Path, category: str) -> Path:
    """The folder of a category (name or synset id) in `folder`. Raises MissingFile with the existing ones."""
    path = folder / synset_of(category)
    if not path.is_dir():
        found = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
        raise MissingFile(path, f"there is no folder of {category!r}; those here are: {', '.join(found) or 'none'}")
    return path


def check_lists(path: Path, lists: dict[str, list[str]], split: str, findings: Findings) -> list[str]:
    """The ids of the objects of a split. lists: split -> ids. path: file of the lists, for messages.

    Raises DamagedFile if there are no ids, or if one is not a plain name of a folder.
    """
    ids = lists.get(split, [])
    if not ids:
        raise DamagedFile(path, f"names no object for {split}")
    for name in ids:
        if name in ("", ".", "..") or len(name) > limits.NAME_LENGTH or set(name) & set("/\\:\0"):
            raise DamagedFile(path, f"names the object {name[:40]!r}; expected the plain name of a folder")
    if repeated := sorted(name for name, times in Counter(ids).items() if times > 1):
        findings.warn(path, f"{split} lists {', '.join(repeated[:8])} more than once")
    for other, others in lists.items():
        if other != split and (shared := sorted(set(ids) & set(others))):
            findings.warn(path, f"{split} shares {len(shared)} objects with {other}, such as {shared[0]}")
    return ids
