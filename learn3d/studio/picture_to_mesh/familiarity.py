"""Predicts the category of a picture, and whether it is an unknown object, by comparing its code with known ones."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn

from learn3d.data.dataset import ViewDataset
from learn3d.methods.mesh_method import MeshMethod
from learn3d.networks.encoders import CODE_SIZE

CENTRES = 120  # clusters of the codes of all training images
IMAGES = 4000  # training images whose codes are clustered
FAR = 0.82  # distance above which a picture is unknown if no other objects were learnt
OTHER = 2.0  # logit of the network above which a picture is unknown
NEAR = 0.55  # distance to a category below which a picture is of it, whatever the network says
# names of the tensors of `KnownCodes` in a checkpoint
KNOWN_CODES = (
    "known_codes",
    "hidden_layer",
    "output_layer",
)
_NEAREST = 3  # centres whose mean distance is compared
_HIDDEN = 64  # width of a classifier
_MEMBERS = 2  # classifiers, whose logits are averaged
_DROPOUT = 0.3
_STEPS = 300
_SCALE = 10.0  # length of the codes that they see


class KnownCodes(NamedTuple):
    """Cluster centres (k-means) of normalised codes, and a network that knows codes of other objects."""

    kinds: Tensor  # float [N, K, C]: centres of the training images of N categories
    # float [H, C + 1]: weights of its hidden units, the bias last; None: not learnt
    hidden: Tensor | None = None
    output: Tensor | None = None  # float [H + 1]: weights of its logit, the bias last

    def fits(self, categories: int) -> bool:
        """Whether the shapes are those of so many categories."""
        if self.kinds.ndim != 3 or self.kinds.shape[::2] != (categories, CODE_SIZE):
            return False
        if self.hidden is None or self.output is None:
            return self.kinds.numel() > 0 and self.hidden is self.output is None
        units = self.output.numel() - 1
        shapes = [(units, CODE_SIZE + 1), (units + 1,)]
        return self.kinds.numel() > 0 and [self.hidden.shape, self.output.shape] == shapes

    def nearest_kind(self, code: Tensor) -> int:
        """The category whose codes are nearest to a code [C]."""
        return int(self._distances(code).argmin())

    def distance(self, code: Tensor, kind: int | None = None) -> float:
        """The distance of a code [C] to the nearest category, or to the category `kind`."""
        distances = self._distances(code)
        return float(distances.min() if kind is None else distances[kind])

    def is_strange(self, code: Tensor) -> bool:
        """Whether a code [C] is of no category: by its distance to the centres, and by the network if it was learnt."""
        if self.hidden is None:
            return float(_distance(code, self.kinds.flatten(0, 1))) > FAR
        if self.distance(code) < NEAR:
            return False
        hidden, output = self.hidden.float(), self.output.float()
        units = F.relu(hidden[:, :-1] @ (_SCALE * F.normalize(code, dim=0)) + hidden[:, -1])
        return float(output[:-1] @ units + output[-1]) > OTHER

    def _distances(self, code: Tensor) -> Tensor:
        """The distance of a code [C] to each category, [N]."""
        return torch.stack([_distance(code, centres) for centres in self.kinds])


def _distance(code: Tensor, centres: Tensor) -> Tensor:
    apart = torch.cdist(F.normalize(code[None], dim=1), centres.float())[0]
    return apart.topk(min(_NEAREST, len(apart)), largest=False).values.mean()


def known_codes(
    method: MeshMethod, dataset: ViewDataset, others: Tensor | None = None
) -> KnownCodes:
    """Known codes of a training set and, optionally, of stored images uint8 [M, 4, S, S] of other objects."""
    chosen = torch.from_numpy(
        np.linspace(0, len(dataset) - 1, min(IMAGES, len(dataset))).astype(np.int64)
    )
    batches = [dataset.batch(part, voxels=False) for part in chosen.split(128)]
    classes = torch.cat([b.class_ids for b in batches])
    codes = _directions(method, (b.images for b in batches))
    count = min(
        CENTRES // dataset.num_classes, int(classes.bincount(minlength=dataset.num_classes).min())
    )
    of_kinds = (codes[classes == kind].numpy() for kind in range(dataset.num_classes))
    options = {"k": count, "minit": "points"}
    kinds = torch.stack(
        [torch.from_numpy(kmeans2(c, **options, rng=np.random.default_rng(0))[0]) for c in of_kinds]
    )
    if others is None:
        return KnownCodes(kinds)
    return KnownCodes(kinds, *learn_others(codes, _directions(method, others.split(128))))


def learn_others(known: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
    """`KnownCodes.hidden` and `.output` that tell normalised codes of training images [N, C] from others [M, C].

    They are small networks with dropout, trained on all codes at once; both classes have the same
    total weight.
    """
    codes = _SCALE * torch.cat([known, others])
    wanted = torch.cat([torch.zeros(len(known)), torch.ones(len(others))])
    share = torch.where(wanted > 0, 0.5 / len(others), 0.5 / len(known))
    hidden, output, bias = [], [], []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for _ in range(_MEMBERS):
            first, last = nn.Linear(codes.shape[1], _HIDDEN), nn.Linear(_HIDDEN, 1)
            network = nn.Sequential(first, nn.ReLU(), nn.Dropout(_DROPOUT), last)
            optimizer = torch.optim.AdamW(network.parameters(), 1e-2, weight_decay=0.1)
            for _ in range(_STEPS):
                optimizer.zero_grad()
                F.binary_cross_entropy_with_logits(
                    network(codes)[:, 0], wanted, share, reduction="sum"
                ).backward()
                optimizer.step()
            hidden.append(torch.cat([first.weight, first.bias[:, None]], 1).detach())
            output.append(last.weight[0].detach() / _MEMBERS)
            bias.append(last.bias.detach() / _MEMBERS)
    return torch.cat(hidden), torch.cat([*output, torch.stack(bias).sum(0)])


@torch.no_grad()
def _directions(method: MeshMethod, images: Iterable[Tensor]) -> Tensor:
    return F.normalize(torch.cat([method.encode(part) for part in images]), dim=1)
