"""Loads and checks data sets by the name of their layout."""

import contextlib
import hashlib
import importlib
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from learn3d.data.conventions import (
    IMAGE_SIZE,
    LAYOUTS,
    SET_FILE,
    SPLITS,
    SYNSETS,
    find_splits,
    has_shards,
    shards_folder,
    synset_of,
)
from learn3d.data.dataset import ViewDataset, concatenate
from learn3d.data.view_bins import AngleBins
from learn3d.files.reading import FAULTS, FaultHandler, MissingFile, OddFile, refuse
from learn3d.terminal import note

Layout = Literal[tuple(LAYOUTS)]
ALL_VIEWS = 2**31  # more views of an object than any data set has


def reader(layout: str) -> ModuleType:
    """The module that reads a layout of `LAYOUTS`; it is imported when it is needed.

    `load(folder, category, split, *, on_fault, ...)` returns a split of a category (name or synset
    id), with the layout's `options` as keywords. It gives each MissingFile, DamagedFile and OddFile
    to `on_fault`, which raises faults; if it does not, the set lacks what is faulty.
    `contents(folder)` returns the categories of a folder and the splits of each. Raises KeyError
    for another name.
    """
    LAYOUTS[layout]
    return importlib.import_module(f"learn3d.data.readers.{layout}")


def check_options(
    layout: str, *, image_size: int = IMAGE_SIZE, view_bins: str | None = None
) -> None:
    """Raise ValueError for an unknown layout, or for an option that it does not support."""
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    if "image_size" not in LAYOUTS[layout].options and image_size != IMAGE_SIZE:
        raise ValueError(
            f"images of the layout {layout!r} have 64x64 pixels, but {image_size} are wanted"
        )
    if view_bins is not None:
        AngleBins.parse(view_bins)
        if not LAYOUTS[layout].angles:
            needed = f"need look-at cameras, but the poses of the layout {layout!r} are rotations"
            raise ValueError(
                f"view_bins {view_bins!r}: cells of azimuth and elevation {needed}; choose another preset"
            )


def require_folder(folder: Path | str) -> None:
    """Raise FileNotFoundError, with the absolute path, if the folder does not exist."""
    folder = Path(folder)
    if not folder.is_dir():
        absolute = "" if folder.is_absolute() else f" ({folder.absolute()})"
        advice = "give the folder of the data set, or make it (learn3d make-dataset)"
        raise MissingFile(folder, f"there is no such folder{absolute}; {advice}")


def find_categories(layout: str, folder: Path | str) -> dict[str, tuple[str, ...]]:
    """The categories of a folder (names or synset ids), as files or shards, and the splits of each.

    Raises what the layout's reader raises if there are neither.
    """
    found = find_splits(folder, f"*/SPLIT/{SET_FILE}")
    try:
        for category, there in reader(layout).contents(folder).items():
            both = {*there, *found.get(category, ())}
            found[category] = tuple(split for split in SPLITS if split in both)
    except (ValueError, OSError):
        if not found:
            raise
    return found


def require_categories(layout: str, folder: Path | str, wanted: Sequence[str]) -> None:
    """Raise MissingFile if a folder does not exist, or has nothing of a category."""
    require_folder(folder)
    try:
        found = set(map(synset_of, find_categories(layout, folder)))
    except FAULTS:
        _check_layout(folder, layout)
        raise
    if missing := [category for category in wanted if synset_of(category) not in found]:
        names = {synset: name for name, synset in SYNSETS.items()}
        there = ", ".join(sorted(names.get(each, each) for each in found)) or "nothing"
        has = f"has no {', '.join(missing)}; in the layout {layout!r} it has {there}"
        raise MissingFile(Path(folder), f"{has}; give --category, or another folder")


def load_dataset(
    layout: Layout,
    folder: Path | str,
    category: str,
    split: str,
    *,
    image_size: int = IMAGE_SIZE,
    view_bins: str | None = None,
    views_per_object: int | None = None,
    poses: Path | None = None,
) -> ViewDataset:
    """Read one split ("train", "val" or "test") of one category, or of several joined by commas.

    Categories that the folder has as shards (`data.shards`) are read from these, and their images
    stay on disk.

    image_size: side of the network's images in pixels; only layouts with larger files have other
    sizes than 64.
    view_bins: cells of azimuth and elevation as view classes, see `AngleBins.parse`; None: the
    layout's own classes.
    views_per_object: number of views of each object (kar: the first ones; else random, the same
    ones in every run); None: as in the layout's published protocol (`training_views`, else all).
    poses: file of a `PoseTable`, which replaces the poses of the data set.

    Raises ValueError for an unknown layout, an unsupported option or a damaged file,
    FileNotFoundError for a missing one. Messages name the file.
    """
    check_options(layout, image_size=image_size, view_bins=view_bins)
    require_folder(folder)
    names = [name.strip() for name in category.split(",")]
    if len(set(names)) != len(names) or not all(names):
        raise ValueError(
            f"category must be one name, or different names joined by commas, got {category!r}"
        )
    protocol = LAYOUTS[layout].training_views
    views = protocol if views_per_object is None and split == "train" else views_per_object
    options = {"image_size": image_size, "views_per_object": views}
    bins = None if view_bins is None else AngleBins.parse(view_bins)
    check = f"learn3d check-dataset {shlex.quote(str(folder))} --layout {layout}"
    odd: list[OddFile] = []

    def on_fault(found: Exception) -> None:
        refuse(found)
        odd.append(found)

    try:
        parts = [_read_split(layout, folder, name, split, on_fault, **options) for name in names]
    except FAULTS as error:
        _check_layout(folder, layout)
        message = f"{error.message}. To list all faults of the data set, run: {check}"
        raise type(error)(error.path, message) from error
    if odd:
        others = f" ({len(odd) - 1} more: {check})" if len(odd) > 1 else ""
        note(f"note: {odd[0]}{others}")
    if bins is not None and poses is None:
        parts = [part.with_bins(bins) for part in parts]
    dataset = concatenate(parts)
    if views is not None:
        dataset = dataset.with_few_views(views, first=protocol is not None)
    if poses is not None:
        from learn3d.data.pose_table import PoseTable  # here, as few runs need its reader

        dataset = PoseTable.read(poses).apply(dataset, str(poses))
        dataset = dataset if bins is None else dataset.with_bins(bins)
    return dataset


def _read_split(
    layout: str,
    folder: Path | str,
    category: str,
    split: str,
    on_fault: FaultHandler,
    **options: Any,
) -> ViewDataset:
    """Read a split of a category from its shards, or with the layout's reader and those of the
    options that it has.
    """
    if has_shards(folder, category, split):
        from learn3d.data import shards  # here, as most data sets have none

        size = options.get("image_size")
        return shards.load(
            folder, category, split, layout=layout, image_size=size, on_fault=on_fault
        )
    known = {name: options[name] for name in LAYOUTS[layout].options if name in options}
    return reader(layout).load(folder, category, split, on_fault=on_fault, **known)


def _check_layout(folder: Path | str, asked: str) -> None:
    """Raise MissingFile if all data sets of a folder have other layouts."""
    found = []
    for layout in LAYOUTS:
        with contextlib.suppress(
            ValueError, OSError
        ):  # a list of objects is damaged, or of another layout
            found += [layout] * bool(reader(layout).contents(folder))
    if found and asked not in found:
        advice = f"add --layout {found[0]} if the command has that option, or choose another folder, preset or run"
        message = f"this is a data set of the layout {found[0]!r}, not {asked!r}; {advice}"
        raise MissingFile(Path(folder), message) from None


@dataclass(frozen=True)
class Problem:
    """A fault or an oddity of one file."""

    path: str
    message: str  # what was found, and what was expected
    severity: Literal["error", "warning"]


@dataclass(frozen=True)
class SplitReport:
    """Faults of one category and split.

    Errors are those that `load_dataset` would raise; it would accept warnings.
    """

    category: str
    split: str
    objects: int  # number of objects that can be read
    problems: tuple[Problem, ...]

    def count(self, severity: str) -> int:
        """Number of the problems that are an "error" or a "warning"."""
        return sum(problem.severity == severity for problem in self.problems)


def check_folder(
    layout: Layout, folder: Path | str, categories: Sequence[str] = (), splits: Sequence[str] = ()
) -> list[SplitReport]:
    """Examine all files of the categories and splits of a folder (default: all that it has).

    A missing category or split is an error of the report. Raises ValueError for an unknown
    layout, FileNotFoundError if the folder does not exist or has nothing of the layout.
    """
    check_options(layout)
    require_folder(folder)
    found = {}
    try:
        found = find_categories(layout, folder)
    except (ValueError, OSError):  # the check finds this fault, too
        if not categories:
            _check_layout(folder, layout)
            raise
    if not found and not categories:
        _check_layout(folder, layout)
        raise MissingFile(
            Path(folder), f"holds nothing of the layout {layout!r}; its files: docs/data-sets.md"
        )
    reports = []
    for category in categories or found:
        seen: dict[bytes, tuple[str, str]] = {}
        for split in splits or found.get(category) or found.get(synset_of(category)) or SPLITS:
            reports.append(_check_split(layout, folder, category, split, seen))
    return reports


def _check_split(
    layout: Layout,
    folder: Path | str,
    category: str,
    split: str,
    seen: dict[bytes, tuple[str, str]],
) -> SplitReport:
    """Read all of a split, and collect what is wrong. seen: what `_shared` has met in the splits
    before.
    """
    found: list[Exception] = []
    objects = 0
    try:
        dataset = _read_split(
            layout, folder, category, split, found.append, views_per_object=ALL_VIEWS
        )
        objects = dataset.num_objects
        if dataset.poses is None:
            advice = f"learn3d estimate-poses --layout {layout} finds them from the masks"
            found.append(OddFile(Path(folder) / category, f"has no poses: {advice}"))
        if has_shards(folder, category, split):
            from learn3d.data import shards

            where = shards_folder(folder, category, split)
            shards.check_arrays(dataset, where, found.append)
        if all(isinstance(each, OddFile) for each in found):  # else not all can be read
            found += [OddFile(Path(folder) / category, text) for text in _shared(dataset, seen)]
    except (ValueError, OSError) as error:
        if all(isinstance(each, OddFile) for each in found):
            found.append(error)  # else it follows from faults that are listed
    problems = [
        Problem(
            str(getattr(each, "path", folder)),
            getattr(each, "message", str(each)),
            "warning" if isinstance(each, OddFile) else "error",
        )
        for each in found
    ]
    return SplitReport(category, split, objects, tuple(dict.fromkeys(problems)))


def _shared(dataset: ViewDataset, seen: dict[bytes, tuple[str, str]]) -> list[str]:
    """A sentence for each earlier split that has the same voxels, or the same pictures if there
    are no voxels. seen: split and object of each digest; those of the data set are added.
    """
    names, kind, parts = dataset.object_names, "voxels", dataset.voxels
    if parts is None:
        names = [dataset.object_names[number] for number in dataset.object_ids]
        kind, parts = "pictures", dataset.images
    shared: dict[str, list[str]] = {}
    for number, name in enumerate(names):
        part = np.ascontiguousarray(parts[np.array([number])])
        split, other = seen.setdefault(hashlib.sha1(part).digest(), (dataset.split, name))
        if split != dataset.split and part.any():
            shared.setdefault(split, []).append(f"{name} ({other} in {split})")
    return [
        f"{len(found)} of the {kind} of {dataset.split} are those of an object of {split}, such as "
        f"{found[0]}; is an object in both splits?"
        for split, found in shared.items()
    ]
