"""Pictures in rows and columns with titles: for contact sheets and for all figures that are made of pictures."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

TILE = 96
MARGIN = 4
HEADER = 18
_TEXT = (60, 60, 60)
_RULE = (205, 205, 205)


def tile(
    rows: Sequence[Sequence[np.ndarray | None]],
    titles: Sequence[str] | None = None,
    *,
    tile_size: int = TILE,
    row_titles: Sequence[str] | None = None,
    rules: Collection[int] = (),
) -> np.ndarray:
    """Arrange pictures uint8 [h,w,3] on a white sheet, each scaled to the same square; uint8 [H,W,3].

    None leaves a place free. Titles stand above the columns and to the left of the rows; a thin line stands above each
    row whose number is in `rules`.
    """
    columns = max(len(row) for row in rows)
    header = HEADER if titles else 0
    left = max(math.ceil(font().getlength(title)) for title in row_titles) + 2 * MARGIN if row_titles else 0
    step = tile_size + MARGIN
    sheet = Image.new("RGB", (left + columns * step + MARGIN, header + len(rows) * step + MARGIN), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for column, title in enumerate(titles or ()):
        middle = left + column * step + MARGIN + tile_size // 2
        draw.text((middle, header - 4), title, fill=_TEXT, anchor="ms", font=font())
    for row, title in enumerate(row_titles or ()):
        middle = header + row * step + MARGIN + tile_size // 2
        draw.text((left - MARGIN, middle), title, fill=_TEXT, anchor="rm", font=font())
    for r, row in enumerate(rows):
        top = header + r * step + MARGIN
        if r in rules:
            draw.line([(0, top - MARGIN // 2), (sheet.width, top - MARGIN // 2)], fill=_RULE)
        for c, picture in enumerate(row):
            if picture is None:
                continue
            image = Image.fromarray(picture)
            if image.size != (tile_size, tile_size):
                image = image.resize((tile_size, tile_size), Image.Resampling.BICUBIC)
            sheet.paste(image, (left + c * step + MARGIN, top))
    return np.asarray(sheet)


@functools.cache
def font(size: int = 12) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own letters."""
    return ImageFont.load_default(size)
