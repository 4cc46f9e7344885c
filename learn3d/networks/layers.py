"""Parts that several networks share: layers and initial weights."""

import itertools

from torch import nn

BATCH_NORM_EPS = 2e-5  # batch norms have it in the published code of Kato and Harada 2019


def linear_layers(*sizes: int) -> nn.Sequential:
    """Linear layers from the first size to the last, with ReLU between them."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def norm_relu(channels: int) -> list[nn.Module]:
    """Batch norm of Kato and Harada 2019, and ReLU."""
    return [nn.BatchNorm2d(channels, eps=BATCH_NORM_EPS), nn.ReLU()]


def initialize_he(network: nn.Module) -> None:
    """He's normal distribution for the weights of all convolutions and linear layers, 0 for their
    biases.
    """
    for module in network.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)):
            nn.init.kaiming_normal_(module.weight)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
