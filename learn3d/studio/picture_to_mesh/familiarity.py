"""Predicts the category of a picture, and whether it is an unknown object: by a network, and by known codes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn

from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.methods.mesh_method import MeshMethod
from learn3d.networks.encoders import CODE_SIZE, ViewClassifier
from learn3d.networks.layers import norm_relu
from learn3d.networks.resnet import ResidualBlock
from learn3d.runs import checkpoint

CENTRES = 120  # clusters of the codes of all training images
IMAGES = 4000  # training images whose codes are clustered
FAR = 0.82  # distance from all kinds at which a picture counts as another thing
CENTRES_NAME, JUDGE_PREFIX = "known_codes", "kind_network."  # names of the tensors in a checkpoint
_NEAREST = 3  # centres whose mean distance is compared
_DISTANCE = 2.0  # weight of the distance, beside the logit
_BATCH = 96  # images in a step
_EPOCHS = 20  # how often all images are seen, on average
_RATE = 2e-3  # largest learning rate
_OTHERS = 0.35  # share of other things in a batch

Vary = Callable[[Tensor, Tensor, np.random.Generator], Tensor]


class KindNetwork(ViewClassifier):
    """Images [B,4,64,64], as for an encoder -> logits [B,K] over K kinds of objects.

    Objects are scaled to one size. Six residual blocks, 0.7 million weights.
    """

    def __init__(self, kinds: int, inverted: bool) -> None:
        nn.Module.__init__(self)
        self.inverted = inverted
        self.convolutions = nn.Sequential(
            nn.PixelUnshuffle(2),
            nn.Conv2d(16, 24, 3, padding=1, bias=False),
            *norm_relu(24),
            ResidualBlock(24, 24),
            ResidualBlock(24, 48, 2),
            ResidualBlock(48, 48),
            ResidualBlock(48, 96, 2),
            ResidualBlock(96, 96),
            ResidualBlock(96, 160, 2),
            nn.AdaptiveAvgPool2d(1),
        )
        self.layers = nn.Sequential(nn.Dropout(0.2), nn.Linear(160, kinds))


class KnownCodes(NamedTuple):
    """Cluster centres (k-means) of normalised codes, and a network that knows kinds and other things."""

    kinds: Tensor  # float [N, K, C]: centres of the training images of N categories
    judge: KindNetwork | None = None  # logits of the categories, then of other things

    @classmethod
    def from_tensors(
        cls, tensors: dict[str, Tensor], categories: int, inverted: bool
    ) -> KnownCodes | None:
        """Those of a checkpoint, None if it has none. ValueError if they are not of so many categories."""
        kinds = tensors.get(CENTRES_NAME)
        if kinds is None:
            return None
        if kinds.ndim != 3 or kinds.shape[::2] != (categories, CODE_SIZE) or not kinds.numel():
            raise ValueError
        weights = checkpoint.starting_with(JUDGE_PREFIX, tensors)
        if not weights:
            return cls(kinds)
        judge = KindNetwork(categories + 1, inverted).requires_grad_(False).eval()
        try:
            judge.load_state_dict(weights)
        except RuntimeError:
            raise ValueError from None
        return cls(kinds, judge)

    def tensors(self) -> dict[str, Tensor]:
        """The tensors for a checkpoint."""
        weights = {} if self.judge is None else self.judge.state_dict()
        named = {JUDGE_PREFIX + name: weight for name, weight in weights.items()}
        return {CENTRES_NAME: self.kinds, **named}

    def probabilities(self, image: Tensor, code: Tensor) -> Tensor:
        """How probably a stored image uint8 [4, S, S] with a code [C] shows each category, and another thing, [N + 1].

        Without a network the nearest category has the probability 1, or another thing if all are
        far away.
        """
        if self.judge is None:
            far = float(_distance(code, self.kinds.flatten(0, 1))) > FAR
            kind = len(self.kinds) if far else int(self.distances(code).argmin())
            return F.one_hot(torch.tensor(kind), len(self.kinds) + 1).float()
        pixels = _pixels(image[None])
        logits = self.judge(torch.cat([pixels, pixels.flip(3)])).mean(0)
        # the codes know renderings better, the network drawings
        apart = torch.cat([self.distances(code), torch.tensor([FAR])])
        return (logits - _DISTANCE * apart).softmax(0)

    def distances(self, code: Tensor) -> Tensor:
        """The distance of a code [C] to each category, [N]."""
        return torch.stack([_distance(code, centres) for centres in self.kinds])


def _distance(code: Tensor, centres: Tensor) -> Tensor:
    apart = torch.cdist(F.normalize(code[None], dim=1), centres.float())[0]
    return apart.topk(min(_NEAREST, len(apart)), largest=False).values.mean()


def _pixels(images: Tensor) -> Tensor:
    return F.adaptive_avg_pool2d(images.float() / 255, MASK_SIZE)


def mirror(images: Tensor, kinds: Tensor, rng: np.random.Generator) -> Tensor:
    """Half of the images mirrored."""
    chosen = torch.from_numpy(rng.random((len(images), 1, 1, 1)) < 0.5)
    return _pixels(torch.where(chosen, images.flip(3), images))


def known_codes(
    method: MeshMethod, dataset: ViewDataset, others: Tensor | None = None
) -> KnownCodes:
    """Known codes of a training set and, optionally, of stored images uint8 [M, 4, S, S] of other objects."""
    chosen = torch.from_numpy(
        np.linspace(0, len(dataset) - 1, min(IMAGES, len(dataset))).astype(np.int64)
    )
    batches = [dataset.batch(part, voxels=False) for part in chosen.split(128)]
    classes = torch.cat([b.class_ids for b in batches])
    images = torch.cat([b.images for b in batches])
    with torch.no_grad():
        codes = torch.cat([method.encode(part) for part in images.split(128)])
    codes = F.normalize(codes, dim=1)
    count = min(
        CENTRES // dataset.num_classes, int(classes.bincount(minlength=dataset.num_classes).min())
    )
    of_kinds = (codes[classes == kind].numpy() for kind in range(dataset.num_classes))
    kinds = torch.stack(
        [
            torch.from_numpy(
                kmeans2(c, np.random.default_rng(0).choice(c, count, False), minit="matrix")[0]
            )
            for c in of_kinds
        ]
    )
    if others is None:
        return KnownCodes(kinds)
    unknown = torch.full((len(others),), dataset.num_classes)
    judge = learn_kinds(
        torch.cat([images, others]), torch.cat([classes, unknown]), dataset.inverted
    )
    return KnownCodes(kinds, judge)


def learn_kinds(images: Tensor, kinds: Tensor, inverted: bool, vary: Vary = mirror) -> KindNetwork:
    """`KnownCodes.judge` from stored images uint8 [M, 4, S, S] and their kinds int64 [M], other things last.

    vary: makes float images [B, 4, 64, 64] in 0 .. 1 of stored ones and their kinds [B], changed at
    random.
    """
    rng = np.random.default_rng(0)
    count = int(kinds.max())
    share = torch.full((count + 1,), (1 - _OTHERS) / count)
    share[count] = _OTHERS
    chance = (share / kinds.bincount())[kinds].double().numpy()
    steps = max(20, _EPOCHS * len(kinds) // _BATCH)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        judge = KindNetwork(count + 1, inverted)
        optimizer = torch.optim.AdamW(judge.parameters(), _RATE, weight_decay=0.05)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _RATE, steps, pct_start=0.1)
        for _ in range(steps):
            rows = torch.from_numpy(rng.choice(len(kinds), _BATCH, p=chance / chance.sum()))
            pixels = vary(images[rows], kinds[rows], rng)
            optimizer.zero_grad()
            F.cross_entropy(judge(pixels), kinds[rows], label_smoothing=0.02).backward()
            optimizer.step()
            schedule.step()
    return judge.requires_grad_(False).eval()
