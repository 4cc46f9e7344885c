"""A method without networks, whose shapes are known beforehand."""

from __future__ import annotations

import torch

from learn3d.methods import Method


class FixedMethod(Method):
    """A subclass encodes and decodes; nothing is trained."""

    image_size = 64

    def __init__(self) -> None:
        self.networks, self.optimizers, self.device, self.precision = {}, {}, torch.device("cpu"), "fp32"

    def create_networks(self):
        raise NotImplementedError

    create_optimizers = training_step = create_networks
