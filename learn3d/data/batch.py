"""The one batch type that every data set returns, and several poses for each image, of which every step draws one."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

import nmr
from learn3d.data.framing import Crops
from learn3d.data.poses import LookAtPoses, Poses


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


@dataclass(frozen=True, eq=False)
class PoseCandidates:
    """C poses for each of M images; candidate c of image i is number i * C + c."""

    poses: LookAtPoses  # M * C
    view_ids: np.ndarray  # int64 [M * C]: their view classes
    weights: np.ndarray  # float32 [M, C], the probabilities of the candidates of an image; their sum is 1

    def __len__(self) -> int:
        return len(self.weights)

    def draw(self, batch: Batch, indices: torch.Tensor, seed: int, step: int) -> Batch:
        """The batch of the samples `indices`, each with one of its poses, drawn by (seed, step).

        The mean gradient is that of the expected loss over the candidates, at the cost of one pose. All terms of the
        loss see the same pose and its class.
        """
        drawn = np.random.default_rng([seed, step, 2]).random(len(indices))
        limits = self.weights[indices].cumsum(axis=1)[:, :-1]
        chosen = indices * self.weights.shape[1] + torch.from_numpy((drawn[:, None] >= limits).sum(axis=1))
        view_ids = torch.from_numpy(self.view_ids[chosen])
        return dataclasses.replace(batch, view_ids=view_ids, poses=self.poses[chosen])
