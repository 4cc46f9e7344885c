"""A picture to look at: some objects of every split of a data set, each in a row, with what the columns show."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

CELL = 64
VIEWS = 8
ROWS = 6
LEFT, TOP = 40, 18  # pixels for the names of the splits and of the columns

LEGEND = (
    "rows: up to 6 objects of each split; columns: up to 8 views, the mask of view 0 (black: the object), the voxels "
    "seen from the front (the darker, the thicker)"
)


@dataclass(frozen=True)
class Row:
    """One object, small: kept for every object until it is known which ones are shown."""

    pictures: bytes  # zlib: uint8 [64, 64 * 9, 3], 8 views over white and the mask of view 0
    thickness: np.ndarray  # uint8 [32, 32]: occupied cells behind each other
    views: tuple[int, ...]  # which views they are


def make_row(rgb: np.ndarray, alpha: np.ndarray, voxels: np.ndarray) -> Row:
    """The row of an object: up to 8 of its views, the first one's mask and its voxels from the front.

    rgb uint8 [n, S, S, 3] over white, alpha uint8 [n, S, S], voxels bool [32, 32, 32] with axes (x, y, z), z = away.
    """
    views = tuple(range(0, len(rgb), -(-len(rgb) // VIEWS)))
    cells = [_small(rgb[view]) for view in views]
    cells += [np.full((CELL, CELL, 3), 255, np.uint8)] * (VIEWS - len(cells))
    cells.append(255 - np.repeat(_small(alpha[0])[..., None], 3, axis=-1))
    front = voxels.sum(axis=2).T[::-1]
    return Row(zlib.compress(np.concatenate(cells, axis=1).tobytes(), 1), front.astype(np.uint8), views)


def draw_sheet(splits: Mapping[str, list[Row]]) -> Image.Image:
    """At most 6 rows of every split that has some (see `LEGEND`), named on the left, below the names of the columns."""
    blocks = {name: _draw_rows(rows) for name, rows in splits.items() if rows}
    height = sum(len(block) for block in blocks.values())
    sheet = Image.new("RGB", (LEFT + CELL * (VIEWS + 2), TOP + height), (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(11)
    views = max((row.views for rows in splits.values() for row in rows), key=len)
    titles = [*(f"view {view}" for view in views), *[""] * (VIEWS - len(views)), f"mask of {views[0]}", "voxels"]
    for column, title in enumerate(titles):
        draw.text((LEFT + CELL * column + CELL // 2, TOP - 5), title, fill=(0, 0, 0), anchor="ms", font=font)
    top = TOP
    for name, block in blocks.items():
        sheet.paste(Image.fromarray(block), (LEFT, top))
        draw.line([(0, top), (sheet.width, top)], fill=(170, 170, 170))
        draw.text((LEFT - 6, top + CELL // 2), name, fill=(0, 0, 0), anchor="rm", font=font)
        top += len(block)
    return sheet


def _draw_rows(rows: list[Row]) -> np.ndarray:
    """At most 6 of the rows, evenly chosen: uint8 [64 R, 64 * 10, 3]; voxels are darker where they are thicker."""
    chosen = [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, ROWS).astype(int))]
    depth = np.stack([row.thickness for row in chosen]).astype(np.int64)
    depth = depth / max(1, depth.max()) * 215 + 40 * (depth > 0)
    front = np.repeat(np.repeat(255 - depth.astype(np.uint8), 2, axis=1), 2, axis=2)
    lines = []
    for row, voxels in zip(chosen, front, strict=True):
        pictures = np.frombuffer(zlib.decompress(row.pictures), np.uint8).reshape(CELL, -1, 3)
        lines.append(np.concatenate([pictures, np.repeat(voxels[..., None], 3, axis=-1)], axis=1))
    return np.concatenate(lines)


def _small(picture: np.ndarray) -> np.ndarray:
    if picture.shape[0] == CELL:
        return picture
    return np.asarray(Image.fromarray(picture).resize((CELL, CELL), Image.Resampling.BOX))
