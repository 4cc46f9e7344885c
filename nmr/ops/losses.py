"""Operator: the loss of silhouettes."""

import torch
from torch import Tensor

from ._kernel import kernel


def soft_iou_in_torch(prediction: Tensor, target: Tensor) -> Tensor:
    """The first result of :func:`soft_iou_loss` by torch: on any device, and differentiable as often
    as wanted.
    """
    axes = tuple(range(1, prediction.ndim))
    intersection = (prediction * target).sum(axes)
    union = (prediction + target).sum(axes) - intersection
    empty = union == 0
    return 1 - torch.where(empty, 1.0, intersection / torch.where(empty, 1.0, union)).mean()


@kernel(
    "loss areas",
    gradients="prediction target",
    constant="areas",
    used_by="soft_iou_loss",
    twice=soft_iou_in_torch,
)
def soft_iou_loss(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """``1 - mean_b I / U`` ``[]`` of pairs ``[B, ...]`` with ``I = sum p t`` and
    ``U = sum (p + t - p t)``.

    If U = 0, I / U counts as 1. The second result is I and U, float64 ``[B, 2]``, for the
    gradient; 0 if U = 0.
    """
    return prediction.new_empty(()), prediction.new_empty((len(prediction), 2), dtype=torch.float64)
