"""Original pixels around each object's box, from which every training step cuts a slightly different input image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

PADDING = 0.15  # of the box, on each side
JITTER = 0.15  # of the box: how far each side moves, at most, in training
SMALLEST, LARGEST = np.full(4, -1.0), np.ones(4)  # shifts of the smallest crop (the box) and of the largest


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
