"""The one batch type that every data set returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    import nmr


@dataclass(frozen=True, eq=False)
class Batch:
    """B views with what training and evaluation need to know about each of them."""

    images: torch.Tensor  # uint8 [B, 4, 64, 64]: R, G, B and the mask, as stored by the data set
    masks: torch.Tensor  # float32 [B, 64, 64] in [0, 1]: anti-aliased silhouettes, row 0 = top
    cameras: nmr.LookAt  # the B cameras that saw the images
    view_ids: torch.Tensor  # int64 [B] in 0 .. K-1: the pose class of each view
    object_ids: torch.Tensor  # int64 [B]: which object of the split each view shows
    voxels: torch.Tensor | None  # bool [B, 32, 32, 32] ground truth in the data set's axes, None where there is none
