"""Crops of photographs with boxes: the input images of Pascal3D+, which a training crops anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

PADDING = 0.15  # padding of a crop on each side, over the side of the box
JITTER = 0.15  # largest shift of each side of a crop in training, over the side of the box
SMALLEST = np.full(4, -1.0)  # shifts of the smallest crop, the box
LARGEST = np.ones(4)  # and of the largest


@dataclass(frozen=True, eq=False)
class Crops:
    """M images, cut to the largest possible crops: the object's box plus 30 % a side."""

    pixels: Sequence[np.ndarray]  # M regions uint8 [h, w, 3]
    boxes: np.ndarray  # float64 [M, 4]: left, top, width, height of the object's box in its region
    size: int  # side of the input images

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def from_images(cls, images: Sequence[np.ndarray], boxes: np.ndarray, size: int) -> Crops:
        """Cut the regions from M images uint8 [H, W, 3]; boxes float [M, 4] overlap their images."""
        boxes = np.array(boxes, np.float64)
        pixels = []
        for image, box in zip(images, boxes, strict=True):
            left, top, right, bottom = bounds(box, LARGEST, image)
            pixels.append(image[top:bottom, left:right].copy())
            box[:2] -= (left, top)
        return cls(pixels, boxes, size)

    @classmethod
    def join(cls, parts: Sequence[Crops]) -> Crops:
        """Concatenate several sets of the same image size."""
        pixels = [pixels for part in parts for pixels in part.pixels]
        return cls(pixels, np.concatenate([part.boxes for part in parts]), parts[0].size)

    def __getitem__(self, samples: np.ndarray) -> Crops:
        """The samples `samples`, int64 [B]; the pixels are shared."""
        return Crops([self.pixels[k] for k in samples], self.boxes[samples], self.size)

    def cut(self, shifts: np.ndarray | None = None) -> np.ndarray:
        """Input images uint8 [M, 3, size, size]: boxes padded by 15 % a side and stretched.

        shifts: float [M, 4] in -1 .. 1: outward shifts of the left, top, right and bottom side,
        in units of 15 % of the box; None for no shifts (evaluation).
        """
        shifts = np.zeros((len(self), 4)) if shifts is None else shifts
        images = np.empty((len(self), 3, self.size, self.size), np.uint8)
        for k, (pixels, box) in enumerate(zip(self.pixels, self.boxes, strict=True)):
            left, top, right, bottom = bounds(box, shifts[k], pixels)
            # the same as scipy.misc.imresize in the published code
            cut = Image.fromarray(pixels[top:bottom, left:right])
            resized = cut.resize((self.size, self.size), Image.Resampling.BILINEAR)
            images[k] = np.asarray(resized).transpose(2, 0, 1)
        return images


def bounds(box: np.ndarray, shift: np.ndarray, image: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of a crop in pixels, rounded and clipped as published."""
    left, top, w, h = box
    padding = PADDING + JITTER * shift  # [4]: left, top, right, bottom
    return (
        max(0, int(left - padding[0] * w)),
        max(0, int(top - padding[1] * h)),
        min(image.shape[1], int(left + w + padding[2] * w)),
        min(image.shape[0], int(top + h + padding[3] * h)),
    )
