"""Predicts the category of a picture, and whether it is an unknown object, by comparing its code with known ones."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.cluster.vq import kmeans2
from torch import Tensor

from learn3d.data.dataset import ViewDataset
from learn3d.methods import MeshMethod

CENTRES = 120  # clusters of the codes of all training images, and of those of other objects
IMAGES = 4000  # training images whose codes are clustered
MOST = 0.82  # distance above which a picture is unknown if no other objects were learnt
OTHER = 0.54  # `KnownCodes.resemblance` above which a picture is unknown
KNOWN_CODES = "known_codes", "other_codes", "code_weights"  # names of the tensors of `KnownCodes` in a checkpoint
_NEAREST = 3  # centres whose mean distance is compared
_SHARPNESS, _RIDGE = 4.0, 0.5  # of the radial basis functions, and of their ridge regression


class KnownCodes(NamedTuple):
    """Cluster centres (k-means) of normalised codes."""

    kinds: Tensor  # float [N, K, C]: centres of the training images of N categories
    others: Tensor | None = None  # float [M, C]: centres of pictures of other objects
    weights: Tensor | None = None  # float [N K + M]: weights of all centres in `resemblance`

    def nearest_kind(self, code: Tensor) -> int:
        """The category whose codes are nearest to a code [C]."""
        return int(torch.stack([_distance(code, centres) for centres in self.kinds]).argmin())

    def resemblance(self, code: Tensor) -> float:
        """Score of a code [C]: near 1 for other objects, near -1 for objects as in the training images."""
        centres = torch.cat([self.kinds.flatten(0, 1), self.others]).float()
        return float(_radial(F.normalize(code[None], dim=1), centres)[0] @ self.weights.float())

    def is_strange(self, code: Tensor) -> bool:
        """Whether a code [C] is like those of other objects or, if none were learnt, far from the training images'."""
        if self.others is not None:
            return self.resemblance(code) > OTHER
        return float(_distance(code, self.kinds.flatten(0, 1))) > MOST


def _radial(points: Tensor, centres: Tensor) -> Tensor:
    return torch.exp(-_SHARPNESS * torch.cdist(points, centres).square())


def _distance(code: Tensor, centres: Tensor) -> Tensor:
    apart = torch.cdist(F.normalize(code[None], dim=1), centres.float())[0]
    return apart.topk(min(_NEAREST, len(apart)), largest=False).values.mean()


def known_codes(method: MeshMethod, dataset: ViewDataset, others: Tensor | None = None) -> KnownCodes:
    """Known codes of a training set and, optionally, of stored images uint8 [M, 4, S, S] of other objects."""
    chosen = torch.from_numpy(np.linspace(0, len(dataset) - 1, min(IMAGES, len(dataset))).astype(np.int64))
    batches = [dataset.batch(part, voxels=False) for part in chosen.split(128)]
    classes, codes = torch.cat([b.class_ids for b in batches]), _directions(method, (b.images for b in batches))
    count = min(CENTRES // dataset.num_classes, int(classes.bincount(minlength=dataset.num_classes).min()))
    kinds = torch.stack([_centres(codes[classes == kind], count) for kind in range(dataset.num_classes)])
    return KnownCodes(kinds) if others is None else learn_others(kinds, _directions(method, others.split(128)))


def learn_others(kinds: Tensor, others: Tensor) -> KnownCodes:
    """Known codes of N categories [N, K, C] and of other objects [M, C], separated by ridge regression.

    The basis functions are radial around all centres; both classes have the same total weight.
    """
    known, centres = kinds.flatten(0, 1), _centres(others, CENTRES)
    samples, middles = torch.cat([known, others]), torch.cat([known, centres])
    wanted = torch.cat([-torch.ones(len(known)), torch.ones(len(others))])
    share = torch.where(wanted < 0, len(samples) / 2 / len(known), len(samples) / 2 / len(others))
    values = _radial(samples, middles)
    system = values.T @ (share[:, None] * values) + _RIDGE * _radial(middles, middles) + 1e-4 * torch.eye(len(middles))
    return KnownCodes(kinds, centres, torch.linalg.solve(system, values.T @ (share * wanted)))


@torch.no_grad()
def _directions(method: MeshMethod, images: Iterable[Tensor]) -> Tensor:
    return F.normalize(torch.cat([method.encode(part).float().cpu() for part in images]), dim=1)


def _centres(directions: Tensor, count: int) -> Tensor:
    rng = np.random.default_rng(0)
    return torch.from_numpy(kmeans2(directions.numpy(), min(count, len(directions)), minit="points", rng=rng)[0])
