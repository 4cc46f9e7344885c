"""Several poses for each image, with their probabilities: training draws one of them in every step."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch

from learn3d.data.batch import Batch
from learn3d.data.poses import LookAtPoses


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
