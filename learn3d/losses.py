"""Losses on shape codes, pose logits, silhouettes and depth, and the MMD, all in float32.

See also nmr.losses.
"""

import math
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from learn3d.distributed import all_reduce_mean


def pose_classification_loss(logits: Tensor, view_ids: Tensor) -> Tensor:
    """L_cls: mean over the batch of -log p(view | code) (the paper's eq. 3).

    logits [B,K]; view_ids int64 [B] in 0..K-1. Differentiable in logits.
    """
    return F.cross_entropy(logits.float(), view_ids)


def domain_confusion_loss(logits: Tensor, form: Literal["log", "probability"]) -> Tensor:
    """L_adv: batch mean of the distance between predicted and uniform probabilities of K views
    (eq. 4).

    "probability", as printed: sum_k (p_k - 1/K)^2. "log", as in the published code: sum_k
    (log(1/K) - log p_k)^2, which is unbounded and much stronger for a confident discriminator.
    logits [B,K]; differentiable.
    """
    views = logits.shape[1]
    if form == "log":
        difference = F.log_softmax(logits.float(), dim=1) + math.log(views)
    else:
        difference = F.softmax(logits.float(), dim=1) - 1 / views
    return difference.square().sum(dim=1).mean()


def depth_losses(depth: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Mean absolute differences of depth maps [B, S, S], and of their slopes.

    A slope is the difference of the depths of pixels two apart in a row or a column (gradient
    matching, Li and Snavely 2018). Only pixels in which both maps show a surface count; others
    are 100 (nmr's `far`) in `depth` and 0 in `target`. Differentiable in depth.
    """
    both = (target > 0) & (depth.detach() < 2 * target)
    error = (depth - target) * both
    rows, columns = both[:, 2:] & both[:, :-2], both[:, :, 2:] & both[:, :, :-2]
    down = (error[:, 2:] - error[:, :-2]).abs() * rows
    right = (error[:, :, 2:] - error[:, :, :-2]).abs() * columns
    counts = torch.stack([pixels.sum().float() for pixels in (both, rows, columns)])
    all_pixels, in_rows, in_columns = all_reduce_mean(counts).clamp(min=1)
    return error.abs().sum() / all_pixels, down.sum() / in_rows + right.sum() / in_columns


def gaussian_prior_loss(codes: Tensor, form: Literal["squared", "norm"]) -> Tensor:
    """L_prior: batch mean of the norm of the codes ("norm", the paper's eq. 5) or of its square
    ("squared", published code).

    codes [B,C]; differentiable; the gradient at a zero code is zero.
    """
    codes = codes.float()
    if form == "squared":
        return codes.square().sum(dim=1).mean()
    return torch.linalg.vector_norm(codes, dim=1).mean()


def silhouette_energy_distance(silhouettes: Tensor, masks: Tensor) -> Tensor:
    """Energy distance between the distributions of silhouettes p and masks t (Szekely and Rizzo
    2013).

    2 mean_ij d(p_i, t_j) - mean_(i != k) d(p_i, p_k); the third term is constant and left out.
    The distance d(a, b) = 1 - a.b / (a.a + b.b - a.b) is 1 - IoU for silhouettes of 0 and 1
    (Tanimoto's similarity, a positive definite kernel: Ralaivola et al. 2005), and 0 for two
    empty ones.

    silhouettes: float [N,D], N >= 2, differentiable; masks: float [M,D], M >= 1.
    """
    across = _tanimoto_distances(silhouettes, masks)
    within = _tanimoto_distances(silhouettes, silhouettes)
    pairs = len(silhouettes) * (len(silhouettes) - 1)
    return 2 * across.mean() - (within.sum() - within.diagonal().sum()) / pairs


def _tanimoto_distances(x: Tensor, y: Tensor) -> Tensor:
    """1 - a.b / (a.a + b.b - a.b) for all pairs of rows: [N,D] and [M,D] -> [N,M]."""
    product = x @ y.T
    union = x.square().sum(1)[:, None] + y.square().sum(1) - product
    return torch.where(union > 0, 1 - product / union.clamp_min(1e-12), 0)


def mmd(
    xx: Tensor, yy: Tensor, xy: Tensor, form: Literal["released", "paper"] = "released"
) -> Tensor:
    """Maximum mean discrepancy between two sets of N codes, x and y; 0 for equal sets.

    xx, yy, xy: float [N,N], squared distances d^2 within x, within y and from x to y;
    differentiable. b is the mean of d^2 over all pairs of different rows of x and y together, a
    constant for the gradient.

    "released", as in the published code and the paper's table: mean(XX + YY - XY - YX) of the sum
    of five kernels exp(-d^2 / (b * 2^i)), i = -2..2. "paper", as printed: the square root of that
    mean for one kernel. The paper gives no bandwidth for it; here i = 0.
    """
    rows = 2 * xx.shape[0]
    width = ((xx.sum() + yy.sum() + 2 * xy.sum()) / (rows * rows - rows)).detach()
    width = width.clamp_min(1e-30)  # all codes equal: every kernel is 1, the MMD is 0

    def mean_kernel(distances: Tensor) -> Tensor:
        if form == "paper":
            return torch.exp(-distances / width).mean()
        kernel = torch.exp(-distances / (4 * width))  # the widest; squaring it gives the next
        total = kernel
        for _ in range(4):
            kernel = kernel.square()
            total = total + kernel
        return total.mean()

    value = mean_kernel(xx) + mean_kernel(yy) - 2 * mean_kernel(xy)
    return value if form == "released" else value.clamp_min(0).sqrt()
