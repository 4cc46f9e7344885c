"""Original pixels around each object's box, from which every training step cuts a slightly different input image."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

PADDING = 0.15  # of the box, on each side
JITTER = 0.15  # of the box: how far each side moves, at most, in training
SMALLEST, LARGEST = np.full(4, -1.0), np.ones(4)  # shifts of the smallest crop, which is the box, and of the largest


@dataclass(frozen=True, eq=False)
class Crops:
    """What M samples can be cut from: the pixels of each image within 30 % around its box (Kato and Harada 2019).

    No other pixel can be part of a crop, so cutting from here equals cutting from the images.
    """

    pixels: np.ndarray  # uint8, flat: M regions [h, w, 3], one after the other
    starts: np.ndarray  # int64 [M]: where each begins
    regions: np.ndarray  # int64 [M, 4]: left, top, right, bottom in the image's pixels, right and bottom excluded
    boxes: np.ndarray  # float64 [M, 4]: left, top, width, height of the object's box in the image's pixels
    size: int  # side of the input images

    def __len__(self) -> int:
        return len(self.starts)

    @classmethod
    def from_images(cls, images: Sequence[np.ndarray], boxes: np.ndarray, size: int) -> Crops:
        """Keep what can be needed of the images uint8 [H, W, 3]; boxes float [M, 4] have pixels in them."""
        boxes = np.asarray(boxes, np.float64)
        regions = np.empty((len(boxes), 4), np.int64)
        for k, (image, box) in enumerate(zip(images, boxes, strict=True)):
            height, width = image.shape[:2]
            regions[k] = bounds(box, LARGEST, width, height)
        ends = np.cumsum((regions[:, 2] - regions[:, 0]) * (regions[:, 3] - regions[:, 1]) * 3)
        starts = np.concatenate([np.zeros(1, np.int64), ends[:-1]])[: len(boxes)]
        pixels = np.empty(ends[-1] if len(ends) else 0, np.uint8)
        for image, (left, top, right, bottom), start, end in zip(images, regions, starts, ends, strict=True):
            pixels[start:end] = image[top:bottom, left:right].reshape(-1)
        return cls(pixels, starts, regions, boxes, size)

    def __getitem__(self, samples: np.ndarray) -> Crops:
        """The samples `samples`, int64 [B]; the pixels are shared."""
        chosen = {name: getattr(self, name)[samples] for name in ("starts", "regions", "boxes")}
        return dataclasses.replace(self, **chosen)

    def cut(self, shifts: np.ndarray | None = None) -> np.ndarray:
        """Input images uint8 [M, 3, size, size]: the box padded by 15 % a side, clipped to the image, and stretched.

        shifts: float [M, 4] in -1 .. 1, how far the left, top, right and bottom side moves outwards, in units of 15 %
        of the box. None: no jitter (evaluation).
        """
        shifts = np.zeros((len(self), 4)) if shifts is None else shifts
        images = np.empty((len(self), 3, self.size, self.size), np.uint8)
        for k, (start, region, box) in enumerate(zip(self.starts, self.regions, self.boxes, strict=True)):
            height, width = region[3] - region[1], region[2] - region[0]
            pixels = self.pixels[start : start + height * width * 3].reshape(height, width, 3)
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


def join(parts: Sequence[Crops]) -> Crops:
    """Several sets, one after the other, of the same size."""
    offsets = np.cumsum([0] + [len(part.pixels) for part in parts])[:-1]
    return Crops(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.starts + offset for part, offset in zip(parts, offsets, strict=True)]),
        np.concatenate([part.regions for part in parts]),
        np.concatenate([part.boxes for part in parts]),
        parts[0].size,
    )
