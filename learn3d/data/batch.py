"""The one batch type that every data set returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch

import nmr
from learn3d.data.crops import Crops
from learn3d.data.poses import Poses


@dataclass(frozen=True, eq=False)
class Batch:
    """B views with what training and evaluation need to know about each of them."""

    images: torch.Tensor  # uint8 [B, 4, S, S]: R, G, B and the mask, in the form that the encoder takes
    masks: torch.Tensor  # float32 [B, 64, 64] in [0, 1]: silhouettes to be matched, row 0 = top
    poses: Poses | None  # of the B cameras; None if unknown
    view_ids: torch.Tensor  # int64 [B] in 0 .. K-1: the view class of each view
    object_ids: torch.Tensor  # int64 [B]: which object of the split each view shows
    class_ids: torch.Tensor  # int64 [B]: which category each object belongs to (0 if there is one only)
    voxels: torch.Tensor | None  # bool [B, 32, 32, 32] ground truth in the data set's axes; None if there is none
    crops: Crops | None = None  # the original images, which the augmentation "crop" cuts colours from; None: unknown
    depth: torch.Tensor | None = None  # float32 [B, 64, 64]: distance along the axis, 0: no surface; None: unknown

    def __len__(self) -> int:
        return len(self.images)

    @property
    def cameras(self) -> nmr.cameras.Camera:
        """The B cameras that saw the images; their poses must be known."""
        return self.poses.cameras()
