"""Parts that several networks share: linear layers with ReLU, initial weights, gradient reversal."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import Tensor, nn

BATCH_NORM_EPS = 2e-5  # batch norms have it in the published code of Kato and Harada 2019


def linear_layers(*sizes: int) -> nn.Sequential:
    """Linear layers from the first size to the last, with ReLU between them."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def initialize_he(network: nn.Module) -> None:
    """He's normal distribution for the weights of all convolutions and linear layers, 0 for their biases."""
    for module in network.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
            nn.init.kaiming_normal_(module.weight)
            if module.bias is not None:
                nn.init.zeros_(module.bias)


class _ReverseGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, factor: float) -> Tensor:
        ctx.factor = factor
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return -ctx.factor * grad, None


def reverse_gradient(values: Tensor, factor: float) -> Tensor:
    """The identity, with the gradient times -factor (Ganin and Lempitsky 2015).

    Networks after it minimise a loss; networks before it maximise the same loss, `factor` times as fast.
    """
    return _ReverseGradient.apply(values, factor)
