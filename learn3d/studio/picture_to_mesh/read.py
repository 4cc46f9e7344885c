"""Reads pictures: from a file to colours and the outline of an object, framed for a network."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy import ndimage

from learn3d.data.crops import Crops
from learn3d.data.dataset import MASK_SIZE
from learn3d.data.framing import MEAN_OBJECT_SIZE, frame, read_photo
from learn3d.data.layouts import LAYOUTS, Layout
from learn3d.data.masks import NEAR, check_mask, keep_object, mask_box
from learn3d.studio.picture_to_mesh.cutting import Box, check_box, find_outline
from learn3d.studio.picture_to_mesh.options import DEFAULTS, CutOptions
from learn3d.terminal import note

_FEW_PIXELS = MASK_SIZE // 2  # a side of an object; in the images of training it has about 45
_MIN_OBJECT_SIZE = 0.05  # smallest possible object size


class Photo(NamedTuple):
    """A picture with the outline of its object."""

    colors: np.ndarray  # uint8 [H, W, 3]
    mask: np.ndarray  # uint8 [H, W], above 127: object
    doubt: str | None = None  # a reason to doubt the outline


def read_picture(
    path: Path,
    mask_path: Path | None = None,
    box: Box | None = None,
    options: CutOptions = DEFAULTS.cut,
) -> Photo:
    """Read a picture. Its mask comes from `mask_path`, from its transparency, or is found in the picture or the box.

    Says in a line how an object was found and what was left out. Raises ValueError if there is no
    object.
    """
    colors, mask = read_photo(path, mask_path, optional=True)
    searched = mask is None or box is not None  # a box counts even if the file has transparency
    doubt = None
    if searched:
        colors, box = _reduce(colors, box, options.searched_side)
        mask, how, doubt = find_outline(colors, box, options)
        wrong = "if the outline in the strip of views is wrong, give --box or --masks"
        note(f"note: {path}: the object was searched, {how}; {wrong}")
    else:
        colors, mask = _reduce_cut_out(colors, mask, options.cut_out_side)
    try:
        check_mask(mask, cropped=not searched)
    except ValueError as error:
        advice = "Give --box or --masks, or cut the object out (transparency)"
        missed = f"no object was found in this photograph. {advice}"
        raise ValueError(f"{mask_path or path}: {missed if searched else error}") from None
    kept, left_out = keep_parts(colors, mask, options)
    if left_out:
        note(f"note: {path}: {left_out}")
    if np.count_nonzero(kept > 127) < options.kept * np.count_nonzero(mask > 127):
        doubt = doubt or "large parts beside it were left out"
    left, top, right, bottom = mask_box(kept)
    if max(right - left, bottom - top) < _FEW_PIXELS:
        size = f"{right - left}x{bottom - top} of the {kept.shape[1]}x{kept.shape[0]} pixels"
        advice = "expect a rough shape, or crop the picture to the object"
        note(f"note: {path}: the object has only {size} that are used; {advice}")
    return Photo(colors, kept, doubt)


def keep_parts(
    colors: np.ndarray, mask: np.ndarray, options: CutOptions = DEFAULTS.cut
) -> tuple[np.ndarray, str | None]:
    """Call `keep_object` with a picture's mask; the parts of a black drawing may be farther apart."""
    return keep_object(mask, options.apart if _is_black(colors, mask, options) else NEAR)


def _is_black(colors: np.ndarray, mask: np.ndarray, options: CutOptions) -> bool:
    inside = mask > 127
    return inside.any() and np.quantile(colors[inside].mean(1), options.black) <= options.ink


def is_uncoloured(colors: np.ndarray, mask: np.ndarray, options: CutOptions = DEFAULTS.cut) -> bool:
    """Whether a picture uint8 [H, W, 3] with its mask uint8 [H, W] is a black drawing without colours."""
    if not _is_black(colors, mask, options):
        return False
    return np.quantile(np.ptp(colors[mask > 127], axis=1), options.grey) <= options.ink


def _reduce(colors: np.ndarray, box: Box | None, side: int) -> tuple[np.ndarray, Box | None]:
    """A picture and a box in it, reduced until its longer side has at most `side` pixels."""
    image = Image.fromarray(colors)
    if box is not None:
        check_box(box, *image.size)
    image.thumbnail((side, side), Image.Resampling.BOX)
    if box is not None:
        scale = max(image.size) / max(colors.shape[:2])
        left, top = (int(scale * each) for each in box[:2])
        wide, high = (max(2, round(scale * each)) for each in box[2:])
        box = left, top, min(wide, image.width - left), min(high, image.height - top)
        if box == (0, 0, *image.size):  # nearly the whole picture
            box = None
    return np.asarray(image), box


def _reduce_cut_out(
    colors: np.ndarray, mask: np.ndarray, side: int
) -> tuple[np.ndarray, np.ndarray]:
    """A picture and its mask, reduced until the longer side of the object has at most `side` pixels."""
    if not (mask > 127).any():
        return colors, mask
    left, top, right, bottom = mask_box(mask)
    scale = side / max(right - left, bottom - top)
    if scale >= 1:
        return colors, mask
    size = [max(1, round(scale * length)) for length in (mask.shape[1], mask.shape[0])]
    images = (Image.fromarray(each) for each in (colors, mask))
    return tuple(np.asarray(each.resize(size, Image.Resampling.BOX)) for each in images)


def prepare_image(
    colors: np.ndarray,
    mask: np.ndarray,
    *,
    crop: bool = True,
    object_size: float = MEAN_OBJECT_SIZE,
    size: int = 64,
    layout: Layout = "kato",
) -> np.ndarray:
    """Turn colours uint8 [H,W,3] and a mask uint8 [H,W] into a stored image uint8 [4,size,size] of a layout.

    The background becomes white. crop: centre the object in a square, so that its larger side
    takes `object_size` of it; without, the picture must be framed like that already and is only
    padded to a square and scaled. Colours are inverted if the layout inverts them. Layouts with
    stretched images (Pascal3D+) keep the background, and `crop` cuts out the mask's box as their
    reader does (`learn3d.data.crops`).

    Raises ValueError if the mask has no pixel above half.
    """
    if LAYOUTS[layout].stretched:
        height, width = mask.shape
        left, top, right, bottom = mask_box(mask) if crop else (0, 0, width, height)
        box = left, top, right - left, bottom - top
        images = colors, np.repeat(mask[..., None], 3, axis=2)
        cut, cut_mask = Crops.from_images(images, np.array([box, box]), size).cut()
        return np.concatenate([cut, cut_mask[:1]])
    object_size = max(object_size, _MIN_OBJECT_SIZE) if crop else None
    return frame(colors, mask, size, object_size=object_size, inverted=LAYOUTS[layout].inverted)


def fill_drawing(
    colors: np.ndarray, mask: np.ndarray, options: CutOptions = DEFAULTS.cut
) -> tuple[np.ndarray, np.ndarray]:
    """Add the white areas between the black lines of a drawing to its mask, or the white lines in a silhouette.

    colors, mask: uint8 [H, W, 3] and [H, W]. Lines may have small gaps. Pictures other than black
    drawings stay as they are. Returns colours on white, and the mask.
    """
    if not _is_black(colors, mask, options):
        return colors, mask
    inside = mask > 127
    gap = math.ceil(options.gap * (1 + max(map(np.ptp, np.nonzero(inside)))))
    margin = gap + 1
    near = ndimage.distance_transform_edt(~np.pad(inside, margin)) <= gap
    closed = ndimage.distance_transform_edt(near) > gap
    solid = ndimage.binary_fill_holes(closed)
    if inside.sum() > options.drawn * solid.sum():  # a silhouette, whose holes are seen through
        solid = closed
    solid = solid[margin:-margin, margin:-margin]
    alpha = mask[..., None] / 255
    on_white = (alpha * colors + 255 * (1 - alpha)).round().astype(np.uint8)
    return on_white, np.where(solid, np.uint8(255), mask)
