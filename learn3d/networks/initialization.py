"""Initial weights other than PyTorch's default ones."""

from __future__ import annotations

from torch import nn


def initialize_he(network: nn.Module) -> None:
    """He's normal distribution for the weights of all convolutions and linear layers, 0 for their biases."""
    for module in network.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
            nn.init.kaiming_normal_(module.weight)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
