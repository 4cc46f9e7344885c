"""Loads data sets by the name of their layout."""

from __future__ import annotations

import contextlib
import shlex
from pathlib import Path
from typing import Literal

from learn3d.data import shards
from learn3d.data.conventions import IMAGE_SIZE, LayoutProperties
from learn3d.data.dataset import ViewDataset, concatenate
from learn3d.data.pose_table import PoseTable
from learn3d.data.readers import READERS
from learn3d.data.view_bins import AngleBins
from learn3d.files.reading import DamagedFile, MissingFile

Layout = Literal[tuple(READERS)]
LAYOUTS: dict[str, LayoutProperties] = {name: reader.PROPERTIES for name, reader in READERS.items()}


def check_options(layout: str, *, image_size: int = IMAGE_SIZE, view_bins: str | None = None) -> None:
    """Raise ValueError for an unknown layout, or for an option of `load_dataset` that it does not support."""
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    if "image_size" not in LAYOUTS[layout].options and image_size != IMAGE_SIZE:
        raise ValueError(f"images of the layout {layout!r} have 64x64 pixels, but {image_size} are wanted")
    if view_bins is not None:
        AngleBins.parse(view_bins)
        if not LAYOUTS[layout].angles:
            raise ValueError(
                f"view_bins {view_bins!r}: cells of azimuth and elevation need look-at cameras, but the poses of the "
                f"layout {layout!r} are rotations; choose a preset for this layout"
            )


def require_folder(folder: Path | str) -> None:
    """Raise FileNotFoundError if the folder of a data set does not exist; the message has its absolute path."""
    folder = Path(folder)
    if not folder.is_dir():
        absolute = "" if folder.is_absolute() else f" ({folder.absolute()})"
        advice = "give the folder of the data set with --data, or make it (learn3d make-dataset)"
        raise MissingFile(folder, f"there is no such folder{absolute}; {advice}")


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
    progress: bool = False,
) -> ViewDataset:
    """Read one split ("train", "val" or "test") of one category, or of several joined by commas.

    Categories that the folder has as shards (`data.shards`) are read from these, and their images stay on disk.

    image_size: side of the network's images in pixels; only layouts with larger files have other sizes than 64.
    view_bins: cells of azimuth and elevation as view classes, see `AngleBins.parse`; None: the layout's own classes.
    views_per_object: number of views of each object (kar: the first ones; else random, the same ones in every run);
    None: as in the layout's published protocol.
    poses: file of a `PoseTable`, which replaces the poses of the data set.
    progress: show a progress bar if the layout has many files.

    Raises ValueError for an unknown layout, an unsupported option or a damaged file, FileNotFoundError for a missing
    one. Messages name the file.
    """
    check_options(layout, image_size=image_size, view_bins=view_bins)
    require_folder(folder)
    names = [name.strip() for name in category.split(",")]
    if len(set(names)) != len(names) or not all(names):
        raise ValueError(f"category must be one name, or different names joined by commas, got {category!r}")
    given = {"image_size": image_size, "views_per_object": views_per_object, "progress": progress}
    options = {name: given[name] for name in LAYOUTS[layout].options}
    stored = [shards.holds(folder, name, split) for name in names]
    parts = []
    try:
        for name, is_stored in zip(names, stored, strict=True):
            if is_stored:
                parts.append(shards.load(folder, name, split, layout=layout, image_size=options.get("image_size")))
            else:
                parts.append(READERS[layout].load(folder, name, split, **options))
        dataset = concatenate(parts)
    except (DamagedFile, MissingFile) as error:
        if others := layouts_in(Path(folder), layout):
            hint = f"this is a data set of the layout {others[0]!r}, not {layout!r}; give another folder, or train "
            hint += f"with a preset for it, or with --layout {others[0]}"
            raise MissingFile(Path(folder), hint) from None
        check = f"learn3d check-dataset {shlex.quote(str(folder))} --layout {layout}"
        message = f"{error.message}. To list all faults of the data set, run: {check}"
        raise type(error)(error.path, message) from error
    if views_per_object is not None and (any(stored) or "views_per_object" not in options):
        dataset = dataset.with_few_views(views_per_object)
    if poses is not None:
        dataset = PoseTable.read(poses).apply(dataset, str(poses))
    return dataset if view_bins is None else dataset.with_bins(AngleBins.parse(view_bins))


def layouts_in(folder: Path, asked: str) -> list[str]:
    """The layouts of a folder's data sets; [] if `asked` is one of them."""
    found = []
    for layout, reader in READERS.items():
        with contextlib.suppress(ValueError, OSError):  # a list of objects is damaged, or of another layout
            found += [layout] * bool(reader.contents(folder))
    return [] if asked in found else found
