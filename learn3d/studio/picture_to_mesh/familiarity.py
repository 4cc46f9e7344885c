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
_STEPS = 120
_SCALE = 10.0  # length of the codes that they see


class KnownCodes(NamedTuple):
    """Cluster centres (k-means) of normalised codes, and a network that knows kinds and other things."""

    kinds: Tensor  # float [N, K, C]: centres of the training images of N categories
    # float [H, C + 1]: weights of its hidden units, the bias last; None: not learnt
    hidden: Tensor | None = None
    # float [N + 1, H + 1]: weights of the categories' logits and of that of other things, the bias last
    output: Tensor | None = None

    def fits(self, categories: int) -> bool:
        """Whether the shapes are those of so many categories."""
        if self.kinds.ndim != 3 or self.kinds.shape[::2] != (categories, CODE_SIZE):
            return False
        if self.hidden is None or self.output is None:
            return self.kinds.numel() > 0 and self.hidden is self.output is None
        units = self.hidden.numel() // (CODE_SIZE + 1)
        shapes = [(units, CODE_SIZE + 1), (categories + 1, units + 1)]
        return self.kinds.numel() > 0 and [self.hidden.shape, self.output.shape] == shapes

    def probabilities(self, code: Tensor) -> Tensor:
        """How probably a code [C] is of each category, and of another thing, [N + 1].

        Without a network the nearest category has the probability 1, or another thing if all are
        far away.
        """
        if self.hidden is None:
            far = float(_distance(code, self.kinds.flatten(0, 1))) > FAR
            kind = len(self.kinds) if far else int(self.distances(code).argmin())
            return F.one_hot(torch.tensor(kind), len(self.kinds) + 1).float()
        hidden, output = self.hidden.float(), self.output.float()
        units = F.relu(hidden[:, :-1] @ (_SCALE * F.normalize(code, dim=0)) + hidden[:, -1])
        return F.softmax(output[:, :-1] @ units + output[:, -1], dim=0)

    def distances(self, code: Tensor) -> Tensor:
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
    unknown = torch.full((len(others),), dataset.num_classes)
    codes = torch.cat([codes, _directions(method, others.split(128))])
    return KnownCodes(kinds, *learn_kinds(codes, torch.cat([classes, unknown])))


def learn_kinds(codes: Tensor, kinds: Tensor) -> tuple[Tensor, Tensor]:
    """`KnownCodes.hidden` and `.output` from normalised codes [M, C] and their kinds int64 [M], other things last.

    They are small networks with dropout, trained on all codes at once; all kinds have the same
    total weight.
    """
    count = int(kinds.max()) + 1
    share = 1 / kinds.bincount().clamp(min=1)
    hidden, output = [], []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for _ in range(_MEMBERS):
            first, last = nn.Linear(codes.shape[1], _HIDDEN), nn.Linear(_HIDDEN, count)
            network = nn.Sequential(first, nn.ReLU(), nn.Dropout(_DROPOUT), last)
            optimizer = torch.optim.AdamW(network.parameters(), 1e-2, weight_decay=0.1)
            for _ in range(_STEPS):
                optimizer.zero_grad()
                F.cross_entropy(network(_SCALE * codes), kinds, share).backward()
                optimizer.step()
            hidden.append(torch.cat([first.weight, first.bias[:, None]], 1).detach())
            output.append(torch.cat([last.weight, last.bias[:, None]], 1).detach() / _MEMBERS)
    weights = torch.cat([part[:, :-1] for part in output], 1)
    return torch.cat(hidden), torch.cat([weights, sum(part[:, -1:] for part in output)], 1)


@torch.no_grad()
def _directions(method: MeshMethod, images: Iterable[Tensor]) -> Tensor:
    return F.normalize(torch.cat([method.encode(part) for part in images]), dim=1)
