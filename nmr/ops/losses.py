"""Operator: the loss of silhouettes."""

import torch
from torch import Tensor

from ._kernel import kernel


def _gradients(
    prediction: Tensor, target: Tensor, areas: Tensor, grad_loss: Tensor
) -> tuple[Tensor, Tensor]:
    """The backward pass of :func:`soft_iou_loss` in torch, for second derivatives."""
    one_each = (-1, *(1,) * (prediction.ndim - 1))
    axes = tuple(range(1, prediction.ndim))
    both = (prediction * target).sum(axes).view(one_each)
    either = (prediction + target).sum(axes).view(one_each) - both
    empty = either == 0
    scale = (
        torch.where(empty, 0.0, -grad_loss / len(prediction))
        / torch.where(empty, 1.0, either).square()
    )
    return (target * (either + both) - both) * scale, (prediction * (either + both) - both) * scale


@kernel(
    "loss areas",
    gradients="prediction target",
    constant="areas",
    used_by="soft_iou_loss",
    twice=_gradients,
)
def soft_iou_loss(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """``1 - mean_b I / U`` ``[]`` of pairs ``[B, ...]`` with ``I = sum p t`` and
    ``U = sum (p + t - p t)``.

    If U = 0, I / U counts as 1. The second result is I and U, float64 ``[B, 2]``, for the
    gradient; 0 if U = 0.
    """
    return prediction.new_empty(()), prediction.new_empty((len(prediction), 2), dtype=torch.float64)
