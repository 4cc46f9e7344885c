"""Frames photographs: a square around them, or around their object, for a network.

A training image is padded to a square around its centre, because a square elsewhere would need an
off-axis projection. So the camera must have been aimed at the middle of the object.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageOps

from learn3d.data.masks import check_mask, keep_object, mask_box
from learn3d.files import limits, sandbox
from learn3d.files.images import PHOTOGRAPHS, open_image, resample
from learn3d.files.reading import DamagedFile

MEAN_OBJECT_SIZE = 0.65  # `ViewDataset.mean_object_size` of Kato's renderings


def read_photo(
    path: Path, mask_path: Path | None = None, *, optional: bool = False
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read colours uint8 [H, W, 3] and mask uint8 [H, W] of an image.

    Both are turned upright (EXIF). The mask is the transparency of the mask file if it has any,
    else its grey values: white is the object. optional: the mask is None if there is neither.
    Raises FileNotFoundError, and ValueError for unreadable files, a missing mask and different
    sizes.
    """
    return sandbox.read(_read, Path(path), mask_path, optional, wanted="a photograph")


class Framed(NamedTuple):
    """A photograph, padded and reduced for a network."""

    image: np.ndarray  # uint8 [4, size, size], in Kato's form
    mask: np.ndarray  # uint8 [64, 64]
    # larger side of the mask's bounding box over the longer side of the photograph
    object_size: float
    touches_border: bool  # True if the mask touches the border of the photograph
    left_out: str | None  # what its mask has beside the object, see `keep_object`


def read_framed(path: Path, mask_path: Path | None, size: int) -> Framed:
    """Read, check and frame a photograph (`frame`); for the sandbox."""
    colors, mask = _read(path, mask_path, False)
    try:
        check_mask(mask)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    mask, left_out = keep_object(mask)
    left, top, right, bottom = mask_box(mask)
    object_size = max(right - left, bottom - top) / max(mask.shape)
    touches_border = min(left, top) == 0 or bottom == mask.shape[0] or right == mask.shape[1]
    small = resample(mask[None].astype(np.float32), limits.MASK_SIZE)[0]
    return Framed(frame(colors, mask, size), small, object_size, touches_border, left_out)


def _open_8_bit(path: Path) -> Image.Image:
    image = _open(path)
    if image.mode.startswith(("I", "F")):  # Pillow would clamp values above 255
        raise DamagedFile(
            path, f"has more than 8 bits a pixel and channel ({image.mode}); save it with 8"
        )
    return image


def _read(
    path: Path, mask_path: Path | None, optional: bool
) -> tuple[np.ndarray, np.ndarray | None]:
    image = _open_8_bit(path)
    mask_image = image if mask_path is None else _open_8_bit(mask_path)
    if mask_image.size != image.size:
        photo, other = (f"{i.width}x{i.height} pixels" for i in (image, mask_image))
        raise DamagedFile(
            path,
            f"has {photo}, its mask {mask_path} {other}; is one of them rotated by 90 degrees?",
        )
    mask = (
        np.asarray(mask_image.convert("RGBA"))[..., 3] if mask_image.has_transparency_data else None
    )
    if mask is None or mask.min() == 255:  # nothing is transparent
        mask = None if mask_path is None else np.asarray(mask_image.convert("L"))
    if mask is None and not optional:
        raise DamagedFile(path, "has no transparency and no mask: cut it out, or give a mask")
    return np.asarray(image.convert("RGBA"))[..., :3], mask


def frame(
    colors: np.ndarray,
    mask: np.ndarray,
    size: int,
    *,
    object_size: float | None = None,
    inverted: bool = True,
) -> np.ndarray:
    """The image uint8 [4, size, size] of a photograph on white: its colours and its mask.

    colors: uint8 [H, W, 3]. mask: uint8 [H, W].
    object_size: centre the mask's bounding box in a square, of which its longer side takes this
    share; None: pad the photograph to a square. inverted: store 255 - colour (Kato's form), so that
    the background is 0. Raises ValueError if the mask has no pixel above half.
    """
    square = None
    if object_size is not None:
        left, top, right, bottom = mask_box(mask)
        side = max(right - left, bottom - top) / object_size
        x = (left + right - side) / 2
        y = (top + bottom - side) / 2
        # only the pixels that the square shows
        first = np.maximum(0, np.floor([y, x])).astype(int)
        last = np.ceil([y + side, x + side]).astype(int)
        shown = tuple(map(slice, first, last))
        colors, mask = colors[shown], mask[shown]
        square = (x - first[1], y - first[0], side)
    alpha = mask[..., None].astype(np.float32) / 255
    planes = np.dstack([np.rint((255 - colors) * alpha), mask]).transpose(2, 0, 1)
    image = resample(planes.astype(np.float32), size, square)
    if not inverted:
        image[:3] = 255 - image[:3]
    return image


def _open(path: Path) -> Image.Image:
    """The image, turned upright by its EXIF data."""
    image = open_image(path, PHOTOGRAPHS, limits.IMAGE_SIDE)
    try:
        return ImageOps.exif_transpose(image)
    except Exception:  # Pillow raises various errors for damaged EXIF data; the image is sound
        return image
