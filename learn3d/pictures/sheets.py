"""Pictures in rows and columns with titles, and the files that they are written into."""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from learn3d.files import writing

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


def natural_colors(images: np.ndarray, *, inverted: bool = True) -> np.ndarray:
    """Stored images uint8 [..., 4, H, W] -> uint8 [..., H, W, 3] as a person wants to see them.

    inverted: colours stored as 255 - colour over black, see `ViewDataset.inverted`.
    """
    colors = np.moveaxis(images[..., :3, :, :], -3, -1)
    return 255 - colors if inverted else colors


def to_uint8(values: Tensor) -> np.ndarray:
    """Grey values in [0,1], any shape -> uint8 with a last axis of 3 equal channels."""
    grey = (values.detach().cpu().float().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return np.repeat(grey[..., None], 3, axis=-1)


def stack(blocks: Sequence[np.ndarray], *, gap: int = 0) -> np.ndarray:
    """Pictures uint8 [h,w,3] below each other, flush left."""
    width = max(block.shape[1] for block in blocks)
    padding = [((0, gap if i < len(blocks) - 1 else 0), (0, width - b.shape[1]), (0, 0)) for i, b in enumerate(blocks)]
    return np.concatenate([np.pad(b, p, constant_values=255) for b, p in zip(blocks, padding, strict=True)])


def magnify(pictures: np.ndarray, zoom: float) -> np.ndarray:
    """The central part of pictures uint8 [N,h,w,3], a share 1 / zoom of each side; they become smaller by it."""
    height, width = pictures.shape[1:3]
    top, left = (round(side * (1 - 1 / zoom) / 2) for side in (height, width))
    return pictures[:, top : height - top, left : width - left]


def with_suffix(path: Path, suffix: str) -> Path:
    """The path with the ending of another kind of picture, such as ".svg"; a name without one gets it added."""
    path = Path(path)
    return path.with_suffix(suffix) if path.suffix in (".png", ".svg", ".gif", ".json") else Path(f"{path}{suffix}")


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write a picture uint8 [H,W,3]."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="PNG", optimize=True)
    writing.write_bytes(path, buffer.getvalue())


def save_gif(path: Path, frames: np.ndarray, *, frames_per_second: float = 15.0) -> None:
    """Write an endless animation from frames uint8 [N,H,W,3]."""
    buffer = io.BytesIO()
    palette = Image.Palette.ADAPTIVE
    first, *others = [Image.fromarray(frame).convert("P", palette=palette, colors=64) for frame in frames]
    first.save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=others,
        duration=round(1000 / frames_per_second),
        loop=0,
        optimize=True,
    )
    writing.write_bytes(path, buffer.getvalue())
