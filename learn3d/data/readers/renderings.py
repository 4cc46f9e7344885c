"""Shared functions of the readers kar and dvr: read the files of many objects, and join them to arrays."""

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from learn3d.data.categories import synset_of
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.view_bins import AngleBins
from learn3d.files import limits
from learn3d.files.reading import DamagedFile, Findings, MissingFile
from learn3d.files.sandbox import Call, read_all
from learn3d.terminal import is_watched


def read_objects(
    names: Sequence[str],
    files: Callable[[str], list[Call]],
    build: Callable[[Path, Any, Path, Any], tuple[Any, np.ndarray]],
    image_size: int,
    findings: Findings,
    title: str,
) -> tuple[np.ndarray, np.ndarray | None, list[Any], list[np.ndarray]] | None:
    """Read N objects of V views each: images uint8 [N * V, 4, S, S], masks uint8 [N * V, 64, 64], poses, shapes.

    The masks are None if they are the images' fourth channel. Returns None if the findings are
    not strict.

    files: the calls for an object, in this order: its cameras, whose folder must exist; its shape
    (voxels or points); then one for each view, which returns an image, a mask and the mask's
    largest value. build: the poses and the shape of an object, from the paths and the content of
    the first two files; it may raise DamagedFile. title: of the progress bar.
    """
    findings.objects = len(names)
    whole = (
        calls
        for calls in map(files, names)
        if findings.attempt(_require_folder, calls[0].path.parent)
    )
    sent, asked = itertools.tee(whole)
    count = len(names) * (len(files(names[0])) - 2) if findings.strict else 0
    images, masks = (
        np.empty((count, *shape), np.uint8)
        for shape in ((4, image_size, image_size), (MASK_SIZE,) * 2)
    )
    poses, shapes, row = [], [], 0
    found = tqdm(read_all(sent), title, len(names), disable=not is_watched(), unit="object")
    for results, calls in zip(found, asked, strict=True):
        cameras_path, shape_path, *paths = (call.path for call in calls)
        cameras, shape, *views = map(findings.take, results)
        if cameras is not None and shape is not None:
            if built := findings.attempt(build, cameras_path, cameras, shape_path, shape):
                if not built[1].any():
                    findings.warn(shape_path, "the grid is empty")
                poses.append(built[0])
                shapes.append(built[1])
        for path, view in zip(paths, views, strict=True):
            if view is not None and view[2] < 128:
                findings.warn(
                    path, f"its mask is empty: the brightest of its values 0 .. 255 is {view[2]}"
                )
            if findings.strict:
                images[row], masks[row] = view[:2]
                row += 1
    return (
        (images, None if image_size == MASK_SIZE else masks, poses, shapes)
        if findings.strict
        else None
    )


def _require_folder(path: Path) -> bool:
    if not path.is_dir():
        raise MissingFile(path, "is missing; expected the folder of an object")
    return True


def join_objects(
    objects: tuple[np.ndarray, np.ndarray | None, list[np.ndarray], list[np.ndarray]] | None,
    names: Sequence[str],
    half_fov_deg: float,
    view_bins: str,
    about: dict[str, Any],
) -> ViewDataset | None:
    """The data set of the result of `read_objects`, with poses as of `check_poses`; None if that is None.

    view_bins: cells of the view classes, see `AngleBins.parse`. about: the result of
    `LayoutProperties.about`.
    """
    if objects is None:
        return None
    images, masks, poses, voxels = objects
    cameras, bins = LookAtPoses(*np.concatenate(poses).T, half_fov_deg), AngleBins.parse(view_bins)
    return ViewDataset(
        **about,
        images=images,
        masks=masks,
        poses=cameras,
        view_ids=bins.ids(cameras).numpy(),
        view_names=tuple(bins.names()),
        object_ids=np.repeat(np.arange(len(names)), [len(each) for each in poses]),
        object_names=tuple(names),
        voxels=np.stack(voxels),
    )


def check_poses(path: Path, poses: np.ndarray, wanted: str) -> np.ndarray:
    """Return poses float64 [V, 3] (azimuth, elevation, distance). Raises DamagedFile if one is out of range."""
    sound = LookAtPoses(*torch.from_numpy(poses.T), 15.0).in_range().numpy()
    if not sound.all():
        row = "row {} has azimuth {:g}, elevation {:g} and distance {:g}".format(
            sound.argmin(), *poses[sound.argmin()]
        )
        raise DamagedFile(path, f"{row}; expected {wanted}")
    return poses


def category_folder(folder: Path, category: str) -> Path:
    """The folder of a category (name or synset id) in `folder`. Raises MissingFile with the existing ones."""
    path = folder / synset_of(category)
    if not path.is_dir():
        found = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
        raise MissingFile(
            path,
            f"there is no folder of {category!r}; those here are: {', '.join(found) or 'none'}",
        )
    return path


def check_lists(
    path: Path, lists: dict[str, list[str]], split: str, findings: Findings
) -> list[str]:
    """The ids of the objects of a split. lists: split -> ids. path: file of the lists, for messages.

    Raises DamagedFile if there are no ids, or if one is not a plain name of a folder.
    """
    ids = lists.get(split, [])
    if not ids:
        raise DamagedFile(path, f"names no object for {split}")
    for name in ids:
        if name in ("", ".", "..") or len(name) > limits.NAME_LENGTH or set(name) & set("/\\:\0"):
            raise DamagedFile(
                path, f"names the object {name[:40]!r}; expected the plain name of a folder"
            )
    if repeated := sorted(name for name, times in Counter(ids).items() if times > 1):
        findings.warn(path, f"{split} lists {', '.join(repeated[:8])} more than once")
    for other, others in lists.items():
        if other != split and (shared := sorted(set(ids) & set(others))):
            findings.warn(
                path, f"{split} shares {len(shared)} objects with {other}, such as {shared[0]}"
            )
    return ids
