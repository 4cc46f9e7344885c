"""What the readers of folders of renderings share: many objects read at once, and the data set made of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from learn3d.data.categories import synset_of
from learn3d.data.conventions import VoxelConvention
from learn3d.data.dataset import MASK_SIZE, SPLITS, ViewDataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.view_bins import AngleBins
from learn3d.files import limits
from learn3d.files.findings import DamagedFile, Findings, MissingFile, Problem
from learn3d.files.sandbox import Call, read_all


class ReadObject(NamedTuple):
    """One object as its files have it; None for the parts that findings tell of."""

    views: list[tuple[np.ndarray, np.ndarray] | None]  # V images uint8 [4, S, S] with masks uint8 [64, 64]
    poses: np.ndarray | None  # float64 [V, 3]: azimuth of the object frame, elevation (degrees), distance
    shape: np.ndarray | None  # voxels bool [32, 32, 32], or points float32 [P, 3]


class ObjectReader(ABC):
    """How the files of one object are read: what worker processes are asked, and what their answers make."""

    @abstractmethod
    def calls(self, name: str) -> list[Call]:
        """What to read of the object."""

    @abstractmethod
    def build(self, name: str, found: list[Any], findings: Findings) -> ReadObject:
        """The object of the results of `calls`."""

    def read(self, ids: Sequence[str], what: str, progress: bool) -> Iterator[ReadObject]:
        """The objects, in order; the first thing that is wrong is raised."""
        for name, found in self._found(ids, what, progress):
            yield self.build(name, found, Findings(strict=True))

    def problems(self, ids: Sequence[str], what: str, progress: bool) -> Iterator[Problem]:
        """Everything that is wrong with the objects."""
        for name, found in self._found(ids, what, progress):
            findings = Findings()
            self.build(name, found, findings)
            yield from findings.problems

    def _found(self, ids: Sequence[str], what: str, progress: bool) -> Iterator[tuple[str, list[Any]]]:
        read = tqdm(read_all(map(self.calls, ids)), what, len(ids), disable=not progress, unit="object")
        yield from zip(ids, read, strict=True)


def take_views(
    findings: Findings, paths: Iterable[Path], views: Iterable[Any]
) -> list[tuple[np.ndarray, np.ndarray] | None]:
    """Images and masks of results of `files.renderings`, with a note of empty masks."""
    taken = []
    for path, result in zip(paths, views, strict=True):
        if (view := findings.take(result)) is not None:
            warn_if_empty(findings, path, view[2])
        taken.append(None if view is None else view[:2])
    return taken


def warn_if_empty(findings: Findings, path: Path, brightest: int) -> None:
    """Note a mask in which nothing is inside, by the brightest of its values."""
    if brightest < 128:
        findings.warn(path, f"its mask is empty: the brightest of its values 0 .. 255 is {brightest}")


def check_poses(path: Path, poses: np.ndarray, wanted: str) -> np.ndarray:
    """Poses float64 [V, 3] (azimuth, elevation, distance) as they are; DamagedFile where one cannot be."""
    low, high = limits.DISTANCE
    azimuth, elevation, distance = poses.T
    bad = (np.abs(azimuth) > limits.ANGLE_DEG) | (np.abs(elevation) >= 90) | (distance < low) | (distance > high)
    if bad.any():
        k = int(bad.argmax())
        found = f"azimuth {azimuth[k]:g}, elevation {elevation[k]:g} and distance {distance[k]:g}"
        raise DamagedFile(path, f"row {k} has {found}; expected {wanted}")
    return poses


def check_split(split: str, splits: Sequence[str] = SPLITS) -> None:
    """Raise a ValueError for a split that the layout does not have."""
    if split not in splits:
        raise ValueError(f"split must be one of {', '.join(splits)}; got {split!r}")


def check_views(views: int | None, most: int) -> None:
    """Raise a ValueError for a number of views per object that the layout does not have."""
    if views is not None and not 1 <= views <= most:
        raise ValueError(f"views_per_object must lie in 1 .. {most}, got {views}")


def category_folder(folder: Path, category: str) -> Path:
    """The folder of a category (name or synset id) below `folder`; a MissingFile says which there are."""
    path = folder / synset_of(category)
    if not folder.is_dir():
        raise MissingFile(folder, "there is no such folder")
    if not path.is_dir():
        found = sorted(p.name for p in folder.iterdir() if p.is_dir())
        raise MissingFile(path, f"there is no folder of {category!r}; those here are: {', '.join(found) or 'none'}")
    return path


def check_ids(path: Path, ids: Sequence[str]) -> None:
    """Raise DamagedFile where one of the ids that a list names is no plain name of a folder."""
    for name in ids:
        if name in ("", ".", "..") or len(name) > limits.NAME_LENGTH or set(name) & set("/\\:\0"):
            raise DamagedFile(
                path, f"names the object {name[:40]!r}; expected the plain name of a folder (no '/', no '..')"
            )


def warn_of_repeats(
    findings: Findings, path: Path, what: str, ids: Sequence[str], others: dict[str, Iterable[str]]
) -> None:
    """Note ids that the list of a split (`what`) holds twice, and those that it shares with the lists of others."""
    if repeated := sorted(name for name, times in Counter(ids).items() if times > 1):
        findings.warn(path, f"{what} lists {', '.join(repeated[:8])}{' ...' * (len(repeated) > 8)} more than once")
    for split, other in others.items():
        if shared := sorted(set(ids) & set(other)):
            findings.warn(path, f"{what} shares {len(shared)} objects with {split}, such as {shared[0]}")


def join_objects(
    objects: Iterable[ReadObject],
    names: Sequence[str],
    views: int,
    image_size: int,
    *,
    category: str,
    split: str,
    half_fov_deg: float,
    view_bins: str,
    convention: VoxelConvention,
) -> ViewDataset:
    """The data set of objects with these names, each seen from `views` sides of its own by one kind of camera.

    view_bins: pose classes as `AngleBins.parse` takes them. Colours are as they are, not inverted.
    """
    images, masks, tables, grids = join_images(objects, len(names), views, image_size)
    poses = LookAtPoses(*np.concatenate(tables).T, half_fov_deg)
    bins = AngleBins.parse(view_bins)
    return ViewDataset(
        category=category,
        split=split,
        images=images,
        poses=poses,
        view_ids=bins.ids(poses).numpy(),
        view_names=tuple(bins.names()),
        object_ids=np.repeat(np.arange(len(names)), views),
        object_names=tuple(names),
        voxels=np.stack(grids),
        convention=convention,
        masks=masks,
        inverted=False,
    )


def join_images(
    objects: Iterable[ReadObject], count: int, views: int, image_size: int
) -> tuple[np.ndarray, np.ndarray | None, list, list]:
    """Images uint8 [count * views, 4, S, S], masks (None where the images' are meant), poses and shapes of objects."""
    images = np.empty((count * views, 4, image_size, image_size), np.uint8)
    masks = None if image_size == MASK_SIZE else np.empty((count * views, MASK_SIZE, MASK_SIZE), np.uint8)
    poses, shapes = [], []
    for i, item in enumerate(objects):
        for row, (image, mask) in enumerate(item.views, i * views):
            images[row] = image
            if masks is not None:
                masks[row] = mask
        poses.append(item.poses)
        shapes.append(item.shape)
    return images, masks, poses, shapes
