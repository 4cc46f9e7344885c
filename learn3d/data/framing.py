"""Turns photographs into the square images of a network: padded with a mask, or cropped by a box.

A photograph is padded to a square around its centre, because a square elsewhere would need an
off-axis projection. So the camera must have been aimed at the middle of the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageOps

from learn3d.data.masks import check_mask, keep_object, mask_box
from learn3d.files import limits, sandbox
from learn3d.files.reading import DamagedFile
from learn3d.files.renderings import PHOTOGRAPHS, open_image, shrink

MEAN_OBJECT_SIZE = 0.65  # `ViewDataset.mean_object_size` of Kato's renderings
PADDING = 0.15  # padding of a crop on each side, over the side of the box
JITTER = 0.15  # largest shift of each side of a crop in training, over the side of the box
SMALLEST = np.full(4, -1.0)  # shifts of the smallest crop, the box
LARGEST = np.ones(4)  # and of the largest


def read_photo(
    path: Path, mask_path: Path | None = None, *, optional: bool = False
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read colours uint8 [H, W, 3] and mask uint8 [H, W] of an image with a mask file or with transparency.

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
    object_size: (
        float  # larger side of the mask's bounding box over the longer side of the photograph
    )
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
    return Framed(*frame(colors, mask, size), object_size, touches_border, left_out)


def _read(
    path: Path, mask_path: Path | None, optional: bool
) -> tuple[np.ndarray, np.ndarray | None]:
    image = _open(path)
    if image.mode.startswith(("I", "F")):  # Pillow would clamp values above 255
        raise DamagedFile(
            path, f"has more than 8 bits a pixel and channel ({image.mode}); save it with 8"
        )
    mask_image = image if mask_path is None else _open(mask_path)
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


def frame(colors: np.ndarray, mask: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The network's image uint8 [4, size, size] and the mask uint8 [64, 64] of a photograph, padded to a square.

    colors: uint8 [H, W, 3]. mask: uint8 [H, W]. The image has Kato's form: 255 - colour over
    white, so that the background is 0, and the mask. Each pixel is the mean over its area.
    """
    alpha = mask[..., None].astype(np.float32) / 255
    return shrink(
        np.dstack([np.rint((255 - colors) * alpha), mask]).transpose(2, 0, 1).astype(np.float32),
        size,
    )


def _open(path: Path) -> Image.Image:
    """The image, turned upright by its EXIF data."""
    image = open_image(path, PHOTOGRAPHS, limits.IMAGE_SIDE)
    try:
        return ImageOps.exif_transpose(image)
    except (
        Exception
    ):  # Pillow raises various errors for damaged EXIF data; the image itself is sound
        return image


@dataclass(frozen=True, eq=False)
class Crops:
    """M images, reduced to the largest possible crops: the object's box plus 30 % a side (Kato and Harada 2019)."""

    pixels: Sequence[np.ndarray]  # M regions uint8 [h, w, 3]
    # int64 [M, 4]: left, top, right, bottom in the image's pixels; right and bottom are excluded
    regions: np.ndarray
    # float64 [M, 4]: left, top, width, height of the object's box in the image's pixels
    boxes: np.ndarray
    size: int  # side of the input images

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def from_images(cls, images: Sequence[np.ndarray], boxes: np.ndarray, size: int) -> Crops:
        """Cut the regions from M images uint8 [H, W, 3]; boxes float [M, 4] overlap their images."""
        boxes = np.asarray(boxes, np.float64)
        regions = [
            bounds(box, LARGEST, *image.shape[1::-1])
            for image, box in zip(images, boxes, strict=True)
        ]
        pairs = zip(images, regions, strict=True)
        pixels = [
            image[top:bottom, left:right].copy() for image, (left, top, right, bottom) in pairs
        ]
        return cls(pixels, np.array(regions, np.int64), boxes, size)

    @classmethod
    def join(cls, parts: Sequence[Crops]) -> Crops:
        """Concatenate several sets of the same image size."""
        regions, boxes = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("regions", "boxes")
        )
        return cls(
            [pixels for part in parts for pixels in part.pixels], regions, boxes, parts[0].size
        )

    def __getitem__(self, samples: np.ndarray) -> Crops:
        """The samples `samples`, int64 [B]; the pixels are shared."""
        return Crops(
            [self.pixels[k] for k in samples], self.regions[samples], self.boxes[samples], self.size
        )

    def cut(self, shifts: np.ndarray | None = None) -> np.ndarray:
        """Input images uint8 [M, 3, size, size]: the box padded by 15 % a side, clipped to the image, and stretched.

        shifts: float [M, 4] in -1 .. 1: outward shifts of the left, top, right and bottom side,
        in units of 15 % of the box; None for no shifts (evaluation).
        """
        shifts = np.zeros((len(self), 4)) if shifts is None else shifts
        images = np.empty((len(self), 3, self.size, self.size), np.uint8)
        for k, (pixels, region, box) in enumerate(
            zip(self.pixels, self.regions, self.boxes, strict=True)
        ):
            left, top, right, bottom = bounds(box, shifts[k], region[2], region[3])
            cut = pixels[top - region[1] : bottom - region[1], left - region[0] : right - region[0]]
            # the same as scipy.misc.imresize in the published code
            resized = Image.fromarray(cut).resize((self.size, self.size), Image.Resampling.BILINEAR)
            images[k] = np.asarray(resized).transpose(2, 0, 1)
        return images


def bounds(
    box: np.ndarray, shift: np.ndarray, width: int, height: int
) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of a crop in pixels of the image, rounded and clipped as in the published code."""
    left, top, w, h = box
    padding = PADDING + JITTER * shift  # [4]: left, top, right, bottom
    return (
        max(0, int(left - padding[0] * w)),
        max(0, int(top - padding[1] * h)),
        min(int(width), int(left + w + padding[2] * w)),
        min(int(height), int(top + h + padding[3] * h)),
    )
