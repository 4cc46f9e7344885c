"""The batch type of all data sets, and candidate poses of their images."""

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
    """B views for training or evaluation."""

    images: torch.Tensor  # uint8 [B, 4, S, S]: R, G, B and the mask; input of the encoder
    masks: torch.Tensor  # float32 [B, 64, 64] in [0, 1]: ground truth silhouettes, row 0 = top
    poses: Poses | None  # B poses; None if unknown
    view_ids: torch.Tensor  # int64 [B] in 0 .. K-1: view classes
    object_ids: torch.Tensor  # int64 [B]: the object in each view, by its number in the split
    class_ids: torch.Tensor  # int64 [B]: the category of each object; 0 if there is only one
    voxels: torch.Tensor | None  # bool [B, 32, 32, 32]: ground truth in the data set's axes; None if unknown
    crops: Crops | None = None  # original images for the augmentation "crop"; None if unknown
    depth: torch.Tensor | None = None  # float32 [B, 64, 64]: along the optical axis, 0: no surface; None if unknown

    def __len__(self) -> int:
        return len(self.images)

    @property
    def cameras(self) -> nmr.cameras.Camera:
        """The B cameras of the images; their poses must be known."""
        return self.poses.cameras()


@dataclass(frozen=True, eq=False)
class PoseCandidates:
    """C candidate poses for each of M images. Pose i * C + c is candidate c of image i."""

    poses: LookAtPoses  # M * C poses
    view_ids: np.ndarray  # int64 [M * C]: their view classes
    weights: np.ndarray  # float32 [M, C]: probabilities of the candidates; each row sums to 1
    prior: np.ndarray  # float32 [M, C]: the same before any reweighting

    def __len__(self) -> int:
        return len(self.weights)

    def draw(self, batch: Batch, indices: torch.Tensor, seed: int, step: int) -> Batch:
        """The batch of the samples `indices` with one candidate pose for each, drawn by `weights`, seed and step.

        So the gradient is an unbiased estimate of that of the expected loss over the candidates, at the cost of one
        pose.
        """
        drawn = np.random.default_rng([seed, step, 2]).random(len(indices))
        limits = self.weights[indices].cumsum(axis=1)[:, :-1]
        chosen = indices * self.weights.shape[1] + torch.from_numpy((drawn[:, None] >= limits).sum(axis=1))
        view_ids = torch.from_numpy(self.view_ids[chosen])
        return dataclasses.replace(batch, view_ids=view_ids, poses=self.poses[chosen])
