"""Pictures in rows and columns with titles, image files, and the contact sheet of a data set."""

import io
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from learn3d.files import writing

TILE = 96  # pixels: side of a picture
MARGIN = 4  # pixels between pictures
HEADER = 18  # pixels: height of the column titles
_TEXT = (60, 60, 60)
_RULE = (205, 205, 205)


def tile(
    rows: Sequence[Sequence[np.ndarray | None]],
    titles: Sequence[str] = (),
    *,
    tile_size: int = TILE,
    row_titles: Sequence[str] = (),
    rules: Collection[int] = (),
) -> np.ndarray:
    """Arrange pictures uint8 [h,w,3] on a white sheet, each scaled to the same square; uint8 [H,W,3].

    None leaves a place free. Titles are above the columns and to the left of the rows. rules:
    numbers of the rows that have a thin line above them.
    """
    font = ImageFont.load_default(12)
    top = HEADER + MARGIN if titles else MARGIN
    left = (
        max((math.ceil(font.getlength(title)) + 2 * MARGIN for title in row_titles), default=0)
        + MARGIN
    )
    step, half = tile_size + MARGIN, tile_size // 2
    size = (left + max(map(len, rows)) * step, top + len(rows) * step)
    sheet = Image.new("RGB", size, (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for column, title in enumerate(titles):
        draw.text(
            (left + column * step + half, HEADER - 4), title, fill=_TEXT, anchor="ms", font=font
        )
    for row, title in enumerate(row_titles):
        draw.text(
            (left - 2 * MARGIN, top + row * step + half), title, fill=_TEXT, anchor="rm", font=font
        )
    for height in (top + row * step - MARGIN // 2 for row in rules):
        draw.line([(0, height), (sheet.width, height)], fill=_RULE)
    for r, row in enumerate(rows):
        for c, picture in enumerate(row):
            if picture is not None:  # `resize` copies a picture that has the size already
                image = Image.fromarray(picture).resize(
                    (tile_size, tile_size), Image.Resampling.BICUBIC
                )
                sheet.paste(image, (left + c * step, top + r * step))
    return np.asarray(sheet)


def natural_colors(images: np.ndarray, *, inverted: bool = True) -> np.ndarray:
    """The colours uint8 [..., H, W, 3] of stored images uint8 [..., 4, H, W].

    inverted: colours are stored as 255 - colour over black, see `ViewDataset.inverted`.
    """
    colors = np.moveaxis(images[..., :3, :, :], -3, -1)
    return 255 - colors if inverted else colors


def magnify(pictures: np.ndarray, zoom: float) -> np.ndarray:
    """The central part of pictures uint8 [N,h,w,3]: a share 1 / zoom of each side, in fewer pixels."""
    height, width = pictures.shape[1:3]
    top, left = (round(side * (1 - 1 / zoom) / 2) for side in (height, width))
    return pictures[:, top : height - top, left : width - left]


def save_png(path: Path, rgb: np.ndarray) -> None:
    """Write a picture uint8 [H,W,3], or [H,W,4] with opacity."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="PNG", optimize=True)
    writing.write_bytes(path, buffer.getvalue())


def save_gif(path: Path, frames: np.ndarray, *, frames_per_second: float = 15.0) -> None:
    """Write an animation that repeats for ever, frames uint8 [N,H,W,3]."""
    buffer = io.BytesIO()
    first, *rest = [
        Image.fromarray(f).convert("P", palette=Image.Palette.ADAPTIVE, colors=64) for f in frames
    ]
    times = {"duration": round(1000 / frames_per_second), "loop": 0}
    first.save(buffer, format="GIF", save_all=True, append_images=rest, optimize=True, **times)
    writing.write_bytes(path, buffer.getvalue())


#: The contact sheet of a data set: side of its pictures in pixels, views of an object, objects of a split, and legend.
CELL, VIEWS, ROWS = 64, 8, 6
LEGEND = (
    "rows: up to 6 objects of each split; columns: up to 8 views, the mask of view 0 (black: the object), the voxels "
    "seen from the front (the darker, the thicker)"
)


def make_row(rgb: np.ndarray, alpha: np.ndarray, voxels: np.ndarray) -> list[np.ndarray]:
    """An object's row of the contact sheet: up to 8 views, the mask of view 0, the voxels, each uint8 [64, 64, 3].

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
    """The contact sheet of a data set with `views` views of each object (see `LEGEND`): uint8 [H, W, 3].

    splits: for each split up to `ROWS` rows by `make_row`.
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
