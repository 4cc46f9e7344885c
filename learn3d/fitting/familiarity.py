"""Whether a model has seen the like of a picture: how far its code lies from those of the training images."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from scipy.cluster.vq import kmeans2
from torch import Tensor

from learn3d.data.dataset import ViewDataset
from learn3d.methods import MeshMethod

CENTRES = 240  # that stand for all codes
IMAGES = 4000  # training images whose codes are clustered
MOST = 0.7  # distance above which a picture is called unknown
_NEAREST = 3


@torch.no_grad()
def known_codes(method: MeshMethod, dataset: ViewDataset) -> Tensor:
    """Centres float32 [K, C] of the directions of the codes of training images (k-means), K = 240 or fewer."""
    chosen = torch.from_numpy(np.linspace(0, len(dataset) - 1, min(IMAGES, len(dataset))).astype(np.int64))
    codes = [method.encode(dataset.batch(part, voxels=False).images).float().cpu() for part in chosen.split(128)]
    directions = F.normalize(torch.cat(codes), dim=1).numpy()
    centres, _ = kmeans2(directions, min(CENTRES, len(directions)), minit="points", rng=np.random.default_rng(0))
    return torch.from_numpy(centres)


def distance(code: Tensor, known: Tensor) -> float:
    """Mean distance of the direction of a code [C] from the three nearest of the known ones [K, C]: 0 .. 2."""
    apart = torch.cdist(F.normalize(code[None], dim=1), known.float())[0]
    return float(apart.topk(min(_NEAREST, len(apart)), largest=False).values.mean())
