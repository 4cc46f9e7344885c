"""Data sets by the name of their layout: the one place that knows which reader goes with which."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from learn3d.data import kato, pascal3d, photos
from learn3d.data.view_bins import AngleBins
from learn3d.data.views import ViewDataset, concatenate

Layout = Literal["kato", "dvr", "kar", "r2n2", "pascal3d", "photos"]
LAYOUTS: tuple[str, ...] = get_args(Layout)


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
    if layout in ("pascal3d", "photos"):
        if views_per_object is not None:
            raise ValueError(f"views_per_object cannot be chosen with the layout {layout!r}: it uses all there are")
        if layout == "pascal3d":
            parts = [pascal3d.load(folder, name, split, image_size=image_size) for name in names]
        else:
            parts = [photos.load(folder, name, split, image_size=image_size, progress=progress) for name in names]
        dataset = concatenate(parts)
        return dataset if view_bins is None else dataset.with_bins(AngleBins.parse(view_bins))
    if layout != "kato":
        raise NotImplementedError(f"the reader of the layout {layout!r} is not written yet")
    if image_size != kato.IMAGE_SIZE or views_per_object is not None:
        raise ValueError("image_size and views_per_object cannot be chosen with the layout 'kato': 24 views of 64x64")
    dataset = concatenate([kato.load(folder, name, split) for name in names])
    return dataset if view_bins is None else dataset.with_bins(AngleBins.parse(view_bins))
