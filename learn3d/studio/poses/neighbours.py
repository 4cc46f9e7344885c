"""Masks, their distances, and the nearest other masks of each (step 4 of `estimate`)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from learn3d.methods.pose_updates import SIZE

_NEIGHBOURS = 8  # nearest masks for smoothing
_NEIGHBOUR_SCALE = 0.1  # distance at which the weight of a neighbour has fallen to 1 / e
_FAR = 9.0  # distance of masks that must not be neighbours


class Masks(NamedTuple):
    """N masks, each with its possible elevations and its object."""

    masks: Tensor  # float32 [N, SIZE^2]
    allowed: Tensor  # bool [N, E]: possible elevations
    objects: Tensor  # int64 [N]: ids

    def select(self, rows: Tensor) -> Masks:
        """The masks `rows`."""
        return Masks(*(part[rows] for part in self))


def distances(masks: Tensor, others: Tensor) -> Tensor:
    """1 - soft IoU of each of B masks with each of C: float [B, C]."""
    common = masks @ others.T
    return 1 - common / (masks.sum(1)[:, None] + others.sum(1) - common).clamp_min(1e-6)


class Neighbours(NamedTuple):
    """The n nearest masks of other objects, for each of N masks and for its mirror image."""

    rows: Tensor  # int64 [2, N, n]: of the masks, of their mirror images
    weights: Tensor  # float32 [2, N, n]

    @classmethod
    def of(
        cls, data: Masks, known: Masks, kinds: Tensor | None = None, count: int = _NEIGHBOURS
    ) -> Neighbours:
        """Neighbours of `data` among `known`: other objects, and other `kinds` (int64 [N])."""
        found = []
        for source in (data.masks, data.masks.reshape(-1, SIZE, SIZE).flip(2).flatten(1)):
            for part in torch.arange(len(source)).split(512):
                far = data.objects[part][:, None] == known.objects
                far |= data.allowed[part].float() @ known.allowed.float().T == 0
                if kinds is not None:
                    far |= kinds[part][:, None] == kinds
                values = distances(source[part], known.masks).masked_fill(far, _FAR)
                found.append(values.topk(min(count, values.shape[1]), 1, largest=False))
        values, rows = (
            torch.cat(part).view(2, len(data.masks), -1) for part in zip(*found, strict=True)
        )
        return cls(rows, torch.exp(-values / _NEIGHBOUR_SCALE))

    def message(self, posterior: Tensor) -> Tensor:
        """Weighted sum of the neighbours' posteriors [N', A, E], mirrored ones at -a: [N, A, E]."""
        back = (-torch.arange(posterior.shape[1])) % posterior.shape[1]
        total = 0
        for mirrored, (rows, weights) in enumerate(zip(self.rows, self.weights, strict=True)):
            source = posterior[:, back] if mirrored else posterior
            for n in range(rows.shape[1]):
                total = total + weights[:, n, None, None] * source[rows[:, n]]
        return total

    def smooth(self, posterior: Tensor, prior: str, rounds: int = 10) -> Tensor:
        """Posteriors [N, A, E] after `rounds` of message passing between neighbours."""
        result = posterior
        for _ in range(rounds):
            result = normalize(posterior**0.3 * (self.message(result) + 1e-3))
            if prior == "uniform":
                result = normalize(result / result.sum(2).mean(0)[:, None].clamp_min(1e-9))
        return result


def normalize(posterior: Tensor) -> Tensor:
    """Posteriors [N, A, E] with the sum 1 for each mask."""
    return posterior / posterior.sum((1, 2), keepdim=True)
