"""The gradient reversal layer (Ganin and Lempitsky 2015)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _ReverseGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, factor: float) -> Tensor:
        ctx.factor = factor
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return -ctx.factor * grad, None


def reverse_gradient(values: Tensor, factor: float) -> Tensor:
    """The values as they are; their gradient times -factor.

    What comes after descends a loss, what comes before climbs it, `factor` times as fast.
    """
    return _ReverseGradient.apply(values, factor)
