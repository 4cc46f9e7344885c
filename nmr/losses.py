"""Losses on silhouettes and meshes."""

from __future__ import annotations

import torch
from torch import Tensor

from . import ops
from ._validate import check_vertices, describe


def soft_iou_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """One minus the mean soft intersection over union: ``1 - mean_b(sum(p t) / sum(p + t - p t))``.

    Parameters
    ----------
    prediction, target : Tensor [B, ...], in [0, 1], of one shape

    Returns
    -------
    scalar Tensor
        0 where all pairs agree and are binary. A pair that is empty on both sides counts as agreement (the published
        code returns NaN); its gradient is 0.

    Raises
    ------
    TypeError, ValueError
        If the shapes differ, or there is nothing to compare.
    """
    if not isinstance(prediction, Tensor) or not isinstance(target, Tensor):
        raise TypeError(f"prediction and target must be tensors, got {describe(prediction)} and {describe(target)}")
    if prediction.shape != target.shape or prediction.ndim < 2 or prediction.shape[0] == 0:
        raise ValueError(
            "prediction and target must have one shape [B, ...] with B >= 1, "
            f"got {describe(prediction)} and {describe(target)}"
        )
    prediction, target = prediction.flatten(1), target.flatten(1)
    product = prediction * target
    intersection = product.sum(1)
    union = (prediction + target - product).sum(1)
    empty = union == 0
    return 1 - (intersection + empty).div(union + empty).mean()


def smoothness_loss(vertices: Tensor, edges: Tensor) -> Tensor:
    """How far neighbouring faces are from flat: mean over meshes of ``sum over edges (1 + cos(theta_e))^2``.

    The form is that of Kato et al. 2018.

    theta_e is the angle between the two faces at edge e: pi (cos = -1) when flat. With a = v1 - v0 along the edge and
    b = v_k - v0 to an opposite corner, each face has the height h = b - a (a.b) / (|a|^2 + e) of length
    ``|b| sqrt(1 - cos(a, b)^2 + e)``, and cos(theta) = h.h' / (|h| |h'| + e), e = 1e-6 in every root and denominator.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    edges : int64 Tensor [E, 4] of :func:`nmr.edge_table`

    Returns
    -------
    scalar Tensor
        Differentiable once in ``vertices``.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and for edges that refer to missing vertices.
    """
    vertices = check_vertices(vertices)
    if vertices.shape[0] == 0:
        raise ValueError(f"vertices must hold at least one mesh, got {describe(vertices)}")
    if not isinstance(edges, Tensor) or edges.dtype != torch.int64 or edges.ndim != 2 or edges.shape[1] != 4:
        raise ValueError(
            f"edges must be an int64 tensor [E, 4] as made by nmr.edge_table(faces), got {describe(edges)}"
        )
    return ops.smoothness(vertices, edges.to(vertices.device)).mean()
