"""Data sets by the name of their layout: the one place that knows which reader goes with which."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import Literal, get_args

from learn3d.data import kato
from learn3d.data.findings import DamagedFile, MissingFile
from learn3d.data.view_bins import AngleBins
from learn3d.data.views import ViewDataset, concatenate

Layout = Literal["kato", "dvr", "kar", "r2n2", "pascal3d", "photos"]
LAYOUTS: tuple[str, ...] = get_args(Layout)
#: Layouts whose images keep their colours as they are (`ViewDataset.inverted` is False).
NATURAL_COLORS = frozenset({"kar", "r2n2", "pascal3d"})


def load_dataset(
    layout: Layout,
    folder: Path | str,
    category: str,
    split: str,
    *,
    image_size: int = 64,
    view_bins: str | None = None,
    views_per_object: int | None = None,
    progress: bool = False,
) -> ViewDataset:
    """Read one split ("train", "val" or "test") of one category, or of several joined by commas, of a folder.

    image_size: side of the network's images in pixels, for layouts that keep larger ones; Kato's renderings are 64x64.
    view_bins: pose classes from cells of azimuth and elevation, see `AngleBins.parse`; None: the layout's own.
    views_per_object: use only so many views of every object; None: what the layout's published protocol uses.
    progress: show a bar where many files are read.

    Raises ValueError for an unknown layout, an option that the layout does not have, and damaged files (named);
    FileNotFoundError for missing ones.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}; got {layout!r}")
    names = [name.strip() for name in category.split(",")]
    if len(set(names)) != len(names) or not all(names):
        raise ValueError(f"category must be one name, or different names joined by commas, got {category!r}")
    bins = None if view_bins is None else AngleBins.parse(view_bins)
    random_views = {"image_size": image_size, "view_bins": bins, "views_per_object": views_per_object}
    # Readers are imported when they are asked for: each needs other packages.
    if layout == "kato":
        _check_fixed_views(layout, image_size, views_per_object)
        load = kato.load
    elif layout == "dvr":
        from learn3d.data import dvr

        _check_fixed_views(layout, image_size, views_per_object)
        load = partial(dvr.load, progress=progress)
    elif layout == "kar":
        from learn3d.data import kar

        load = partial(kar.load, **random_views, progress=progress)
    elif layout == "r2n2":
        from learn3d.data import r2n2

        load = partial(r2n2.load, **random_views, progress=progress)
    elif views_per_object is not None:
        raise ValueError(f"views_per_object cannot be chosen with the layout {layout!r}: it uses all there are")
    elif layout == "pascal3d":
        from learn3d.data import pascal3d

        load = partial(pascal3d.load, image_size=image_size)
    else:
        from learn3d.data import photos

        load = partial(photos.load, image_size=image_size, progress=progress)
    try:
        dataset = concatenate([load(folder, name, split) for name in names])
    except (DamagedFile, MissingFile) as error:
        check = f"python tools/check_dataset.py {shlex.quote(str(folder))} --layout {layout}"
        raise type(error)(
            error.path, f"{error.message}. All that is wrong with the data set is listed by: {check}"
        ) from error
    return dataset.with_bins(bins) if bins is not None and layout not in ("kar", "r2n2") else dataset


def _check_fixed_views(layout: str, image_size: int, views_per_object: int | None) -> None:
    if image_size != kato.IMAGE_SIZE or views_per_object is not None:
        raise ValueError(
            f"image_size and views_per_object cannot be chosen with the layout {layout!r}: 24 views, 64x64"
        )
