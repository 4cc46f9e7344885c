"""From a photograph to the square image that a network sees: framed by a mask, or cut by a box.

The photograph is padded to a square around its centre: a square cut out elsewhere would be another projection, of a
camera that looks past the object. So the camera must have been aimed at the middle of the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageOps

from learn3d.files import limits, sandbox
from learn3d.files.reading import DamagedFile
from learn3d.files.renderings import MASK_SIZE, PHOTOGRAPHS, area_weights, open_image

OBJECT_SHARE = 0.65  # of the side of the square that the object takes in Kato's renderings, about
TOLERANCE = 0.12  # of colours, for `threshold_mask`
PADDING = 0.15  # of the box, on each side
JITTER = 0.15  # of the box: how far each side moves, at most, in training
SMALLEST, LARGEST = np.full(4, -1.0), np.ones(4)  # shifts of the smallest crop (the box) and of the largest
_MEMORY_PER_PIXEL = 40  # bytes, for masking and framing
_PIXELS_PER_SECOND = 2e7


def read_photo(path: Path, mask_path: Path | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Colours uint8 [H, W, 3] and mask uint8 [H, W] of an image file and a mask file, or of an image with transparency.

    Both are turned upright (EXIF). A mask file is its transparency if it has some, else grey: white is the object.
    Raises FileNotFoundError, and ValueError for what cannot be read, no mask at all, and sizes that differ.
    """
    return sandbox.read(_read, Path(path), mask_path, wanted="a photograph")


def read_picture(path: Path, most_side: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours uint8 [H, W, 3] and transparency uint8 [H, W] of an image file, upright; None: nothing is transparent.

    Made smaller if a side has more than `most_side` pixels. Raises FileNotFoundError, and ValueError for what cannot be
    read.
    """
    return sandbox.read(_read_picture, Path(path), most_side, wanted="a photograph")


class Framed(NamedTuple):
    """A photograph as a network sees it."""

    image: np.ndarray  # uint8 [4, size, size], in Kato's form
    mask: np.ndarray  # uint8 [64, 64]
    share: float  # larger side of the mask's box in the photograph, over the photograph's longer side
    touches_border: bool  # the mask reaches the end of the photograph


def read_framed(path: Path, mask_path: Path | None, size: int) -> Framed:
    """For worker processes: a photograph read, checked and framed (`frame`)."""
    colors, mask = _read(path, mask_path)
    try:
        check_mask(mask)
    except ValueError as error:
        raise DamagedFile(path, str(error)) from None
    left, top, right, bottom = mask_box(mask)
    share = max(right - left, bottom - top) / max(mask.shape)
    touches_border = min(left, top) == 0 or bottom == mask.shape[0] or right == mask.shape[1]
    return Framed(*frame(colors, mask, size), share, touches_border)


def _read_picture(path: Path, most_side: int) -> tuple[np.ndarray, np.ndarray | None]:
    image = _open_photo(path)
    alpha = _transparency(image)
    image = image.convert("RGBA")
    image.thumbnail((most_side, most_side))
    pixels = np.asarray(image)
    return pixels[..., :3], None if alpha is None else pixels[..., 3]


def _read(path: Path, mask_path: Path | None) -> tuple[np.ndarray, np.ndarray]:
    image = _open_photo(path)
    mask_image = image if mask_path is None else _open(mask_path)
    mask = _transparency(mask_image)
    if mask is None and mask_path is None:
        wanted = "cut it out, or give a mask (reconstruct: --box, --masks, --plain-background)"
        raise DamagedFile(path, f"has no transparency and no mask: {wanted}")
    mask = np.asarray(mask_image.convert("L")) if mask is None else mask
    if mask_image.size != image.size:
        photo, other = (f"{i.width}x{i.height} pixels" for i in (image, mask_image))
        raise DamagedFile(path, f"has {photo}, its mask {mask_path} {other}; does one of them lie on its side?")
    return np.asarray(image.convert("RGBA"))[..., :3], mask


def check_mask(mask: np.ndarray, *, cropped: bool = False) -> None:
    """Raise ValueError for a mask [H, W] that is empty, full, or probably inverted.

    cropped: the picture may end where the object does, so that much of its border is object.
    """
    inside = mask > 127
    if not inside.any():
        raise ValueError("its mask is empty: no pixel is brighter than half; white must be the object")
    if inside.all():
        raise ValueError("its mask is all white: white must be the object, black the background")
    border = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
    if border.mean() > (max(0.5, inside.mean()) if cropped else 0.5):
        asked = "is it black where the object is, or is the background in it?"
        raise ValueError(f"its mask covers {border.mean():.0%} of the border; {asked}")


def threshold_mask(colors: np.ndarray, tolerance: float = TOLERANCE) -> np.ndarray:
    """All that has not the colour of the picture's border, without holes: uint8 [H,W], 0 or 255.

    colors: uint8 [H,W,3]. The background's colour is the median of the border; what differs from it by less than
    `tolerance` (0 .. 1, of the largest difference in any channel) is background.
    """
    from scipy import ndimage  # here, as workers import this module

    border = np.concatenate([colors[0], colors[-1], colors[:, 0], colors[:, -1]])
    difference = np.abs(colors - np.median(border, axis=0)).max(axis=2)
    return 255 * ndimage.binary_fill_holes(difference > 255 * tolerance).astype(np.uint8)


def largest_region(mask: np.ndarray) -> tuple[np.ndarray, bool]:
    """The largest connected region of a mask uint8 [H,W]; whether another one has a tenth of its pixels or more."""
    from scipy import ndimage

    regions, count = ndimage.label(mask > 127)
    if count < 2:
        return mask, False
    sizes = np.bincount(regions.ravel())[1:]
    second, first = np.sort(sizes)[-2:]
    return np.where(regions == 1 + sizes.argmax(), mask, np.uint8(0)), bool(10 * second >= first)


def mask_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right, bottom (excluded) of the pixels above half."""
    rows, columns = (np.flatnonzero((mask > 127).any(axis=axis)) for axis in (1, 0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def frame(colors: np.ndarray, mask: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The network's image uint8 [4, size, size] and the mask uint8 [64, 64] of a photograph padded to a square.

    The image has Kato's form: 255 - colour over white, so that all but the object is 0; then the mask. Each pixel is
    the mean of what it covers.
    """
    alpha = mask[..., None].astype(np.float32) / 255
    stored = np.dstack([np.rint((255 - colors) * alpha), mask]).transpose(2, 0, 1).astype(np.float32)
    image = _shrink(stored, size)
    return image, image[3] if size == MASK_SIZE else _shrink(stored[3:], MASK_SIZE)[0]


def _shrink(planes: np.ndarray, size: int) -> np.ndarray:
    side = max(planes.shape[1:])
    rows, columns = (area_weights(side, size)[:, (side - n) // 2 :][:, :n] for n in planes.shape[1:])
    return np.rint(rows @ planes @ columns.T).astype(np.uint8)


def _open_photo(path: Path) -> Image.Image:
    image = _open(path)
    if image.mode.startswith(("I", "F")):  # Pillow would make white of all that is above 255
        raise DamagedFile(path, f"has more than 8 bits a pixel and channel ({image.mode}); save it with 8")
    return image


def _open(path: Path) -> Image.Image:
    """The image, upright: cameras write the pixels as they lie on the sensor, and the turn into the EXIF data."""
    image = open_image(path, PHOTOGRAPHS, limits.IMAGE_SIDE)
    sandbox.allow(_MEMORY_PER_PIXEL * image.width * image.height, image.width * image.height / _PIXELS_PER_SECOND)
    try:
        return ImageOps.exif_transpose(image)
    except Exception:  # its EXIF data are damaged: whatever Pillow's parser raises, the picture itself is sound
        return image


def _transparency(image: Image.Image) -> np.ndarray | None:
    """The alpha channel uint8 [H, W]; None if nothing is transparent."""
    if not image.has_transparency_data:
        return None
    alpha = np.asarray(image.convert("RGBA"))[..., 3]
    return None if alpha.min() == 255 else alpha


@dataclass(frozen=True, eq=False)
class Crops:
    """The pixels of M images within 30 % around the object's box: all that a crop can show (Kato and Harada 2019)."""

    pixels: Sequence[np.ndarray]  # M regions uint8 [h, w, 3]
    regions: np.ndarray  # int64 [M, 4]: left, top, right, bottom in the image's pixels, right and bottom excluded
    boxes: np.ndarray  # float64 [M, 4]: left, top, width, height of the object's box in the image's pixels
    size: int  # side of the input images

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def from_images(cls, images: Sequence[np.ndarray], boxes: np.ndarray, size: int) -> Crops:
        """Keep what can be needed of the images uint8 [H, W, 3]; boxes float [M, 4] have pixels in them."""
        boxes = np.asarray(boxes, np.float64)
        pixels, regions = [], []
        for image, box in zip(images, boxes, strict=True):
            left, top, right, bottom = bounds(box, LARGEST, image.shape[1], image.shape[0])
            pixels.append(image[top:bottom, left:right].copy())
            regions.append((left, top, right, bottom))
        return cls(pixels, np.array(regions, np.int64), boxes, size)

    def __getitem__(self, samples: np.ndarray) -> Crops:
        """The samples `samples`, int64 [B]; the pixels are shared."""
        return Crops([self.pixels[k] for k in samples], self.regions[samples], self.boxes[samples], self.size)

    def cut(self, shifts: np.ndarray | None = None) -> np.ndarray:
        """Input images uint8 [M, 3, size, size]: the box padded by 15 % a side, clipped to the image, and stretched.

        shifts: float [M, 4] in -1 .. 1, how far the left, top, right and bottom side moves outwards, in units of 15 %
        of the box. None: no jitter (evaluation).
        """
        shifts = np.zeros((len(self), 4)) if shifts is None else shifts
        images = np.empty((len(self), 3, self.size, self.size), np.uint8)
        for k, (pixels, region, box) in enumerate(zip(self.pixels, self.regions, self.boxes, strict=True)):
            left, top, right, bottom = bounds(box, shifts[k], region[2], region[3])
            cut = pixels[top - region[1] : bottom - region[1], left - region[0] : right - region[0]]
            # scipy.misc.imresize, which the published code calls, was this.
            resized = Image.fromarray(cut).resize((self.size, self.size), Image.Resampling.BILINEAR)
            images[k] = np.asarray(resized).transpose(2, 0, 1)
        return images


def bounds(box: np.ndarray, shift: np.ndarray, width: int, height: int) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of a crop in whole pixels of the image, as the published code rounds and clips them."""
    left, top, w, h = box
    padding = PADDING + JITTER * shift  # left, top, right, bottom
    return (
        max(0, int(left - padding[0] * w)),
        max(0, int(top - padding[1] * h)),
        min(int(width), int(left + w + padding[2] * w)),
        min(int(height), int(top + h + padding[3] * h)),
    )


def join_crops(parts: Sequence[Crops]) -> Crops:
    """Several sets, one after the other, of the same size."""
    regions, boxes = (np.concatenate([getattr(part, name) for part in parts]) for name in ("regions", "boxes"))
    return Crops([pixels for part in parts for pixels in part.pixels], regions, boxes, parts[0].size)
