"""The contact sheet of a data set: some objects of each split."""

from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image

from learn3d.pictures import tile

#: Side of the pictures in pixels, views of an object, objects of a split, and legend.
CELL = 64
VIEWS = 8
ROWS = 6
LEGEND = (
    "rows: up to 6 objects of each split; columns: up to 8 views, the mask of view 0 "
    "(black: the object), the voxels seen from the front (the darker, the thicker)"
)


def make_row(rgb: np.ndarray, alpha: np.ndarray, voxels: np.ndarray) -> list[np.ndarray]:
    """An object's row: up to 8 views, the mask of view 0 and the voxels, each uint8 [64, 64, 3].

    rgb uint8 [n, S, S, 3] over white, alpha uint8 [n, S, S], voxels bool [32, 32, 32] with axes
    (x, y, z), z = away.
    """
    thickness = voxels.sum(axis=2).T[::-1]
    # the grid's own square is grey
    ink = np.where(thickness > 0, 60 + 195 * thickness / max(1, thickness.max()), 15)
    pictures = [*map(Image.fromarray, rgb[_shown_views(len(rgb))]), Image.fromarray(255 - alpha[0])]
    pictures.append(Image.fromarray(255 - ink.astype(np.uint8)))
    return [
        np.asarray(p.resize((CELL, CELL), Image.Resampling.BOX).convert("RGB")) for p in pictures
    ]


def draw_sheet(splits: Mapping[str, Sequence[list[np.ndarray]]], views: int) -> np.ndarray:
    """The contact sheet of a data set (see `LEGEND`): uint8 [H, W, 3].

    views: number of views of each object. splits: for each split up to `ROWS` rows by `make_row`.
    """
    rows = [row for of_split in splits.values() for row in of_split]
    names = [
        "" if number else split
        for split, of_split in splits.items()
        for number in range(len(of_split))
    ]
    titles = [*(f"view {view}" for view in _shown_views(views)), "mask of 0", "voxels"]
    return tile(
        rows,
        titles,
        tile_size=CELL,
        row_titles=names,
        rules=[r for r, name in enumerate(names) if name],
    )


def _shown_views(views: int) -> range:
    return range(0, views, -(-views // VIEWS))
