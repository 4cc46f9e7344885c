"""A picture to look at: some objects of every split of a data set, each in a row, with what the columns show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image

from learn3d.pictures.sheets import tile

CELL = 64
VIEWS = 8
ROWS = 6

LEGEND = (
    "rows: up to 6 objects of each split; columns: up to 8 views, the mask of view 0 (black: the object), the voxels "
    "seen from the front (the darker, the thicker)"
)


def make_row(rgb: np.ndarray, alpha: np.ndarray, voxels: np.ndarray) -> list[np.ndarray]:
    """The pictures of an object, uint8 [64, 64, 3]: up to 8 views, the mask of view 0, the voxels from the front.

    rgb uint8 [n, S, S, 3] over white, alpha uint8 [n, S, S], voxels bool [32, 32, 32] with axes (x, y, z), z = away.
    """
    thickness = voxels.sum(axis=2).T[::-1]
    ink = np.where(thickness > 0, 60 + 195 * thickness / max(1, thickness.max()), 15)  # the grid's own square is grey
    pictures = [*map(Image.fromarray, rgb[_shown(len(rgb))]), Image.fromarray(255 - alpha[0])]
    pictures.append(Image.fromarray(255 - ink.astype(np.uint8)))
    return [np.asarray(p.resize((CELL, CELL), Image.Resampling.BOX).convert("RGB")) for p in pictures]


def draw_sheet(splits: Mapping[str, Sequence[list[np.ndarray]]], views: int) -> np.ndarray:
    """At most 6 rows of every split, named on the left, below the names of the columns (see `LEGEND`): uint8 [H, W, 3].

    splits: rows that `make_row` made of objects with so many views, by split.
    """
    rows, names = [], []
    for split, of_split in splits.items():
        chosen = np.unique(np.linspace(0, len(of_split) - 1, ROWS).astype(int)) if of_split else ()
        rows += [of_split[i] for i in chosen]
        names += [split, *[""] * (len(chosen) - 1)][: len(chosen)]
    titles = [*(f"view {view}" for view in _shown(views)), "mask of 0", "voxels"]
    return tile(rows, titles, tile_size=CELL, row_titles=names, rules=[r for r, name in enumerate(names) if name])


def _shown(views: int) -> range:
    return range(0, views, -(-views // VIEWS))
