"""The smallest encoder and generator that fit the training loop (milliseconds a step); a method without networks."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from learn3d.methods.method import Method
from learn3d.networks.encoders import CODE_SIZE, ENCODERS, SmallConvEncoder
from learn3d.networks.generators import GENERATORS, SmallSphereGenerator, Symmetry
from learn3d.networks.layers import linear_layers


class TinyEncoder(SmallConvEncoder):
    def __init__(self, inverted: bool = True) -> None:
        nn.Module.__init__(self)
        self.convolutions = nn.Sequential(nn.Conv2d(4, 4, 8, stride=8), nn.ReLU())
        self.layers = nn.Linear(256, CODE_SIZE)


class TinyGenerator(SmallSphereGenerator):
    def __init__(self, symmetry: Symmetry | None = None) -> None:
        super().__init__(symmetry)
        self.layers = linear_layers(CODE_SIZE, 16, self.outputs)
        with torch.no_grad():
            for parameter in self.layers[-1].parameters():
                parameter.mul_(0.1)  # nearly a sphere, whatever the codes are


def put_in_place(patch: pytest.MonkeyPatch | None = None) -> None:
    """Let the names conv, conv-small and sphere-small mean these.

    Until `patch` is undone, or as long as this process lives.
    """
    patch = patch or pytest.MonkeyPatch()
    patch.setitem(ENCODERS, "conv", TinyEncoder)
    patch.setitem(ENCODERS, "conv-small", TinyEncoder)
    patch.setitem(GENERATORS, "sphere-small", TinyGenerator)


class FixedMethod(Method):
    """A subclass encodes and decodes; nothing is trained."""

    image_size = 64

    def __init__(self) -> None:
        self.networks, self.optimizers, self.device, self.precision = (
            nn.ModuleDict(),
            {},
            torch.device("cpu"),
            "fp32",
        )

    def create_networks(self):
        raise NotImplementedError

    create_optimizers = create_networks
