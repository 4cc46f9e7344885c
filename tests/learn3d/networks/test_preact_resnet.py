"""The pre-activation ResNet-18."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from learn3d.networks.preact_resnet import PreactResNet18, grey_background


def test_layers_are_the_published_ones() -> None:
    network = PreactResNet18()
    stem = [(7, 2, 3, 64)]
    first = [(3, 1, 64, 64)] * 4
    later = []
    for a in (64, 128, 256):
        later += [(3, 2, a, 2 * a), (1, 2, a, 2 * a)] + [(3, 1, 2 * a, 2 * a)] * 3
    convolutions = [m for m in network.modules() if isinstance(m, nn.Conv2d)]
    found = sorted((c.kernel_size[0], c.stride[0], c.in_channels, c.out_channels) for c in convolutions)
    assert found == sorted(stem + first + later)
    assert all(c.bias is None for c in convolutions)
    assert len([m for m in network.modules() if isinstance(m, nn.BatchNorm2d)]) == 17
    assert (network.code.in_features, network.code.out_features) == (512 * 7 * 7, 512)


@pytest.mark.parametrize("size", [32, 96, 224])
def test_codes_of_any_multiple_of_32_pixels(size: int) -> None:
    network = PreactResNet18(size, channels=4).eval()
    codes = network(torch.rand(2, 4, size, size))
    assert codes.shape == (2, 512)
    assert (codes < 0).any()


@pytest.mark.parametrize("size", [0, 16, 100])
def test_other_sizes_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match=rf"image_size must be a multiple of 32 for PreactResNet18, got {size}"):
        PreactResNet18(size)


def test_background_is_grey() -> None:
    images = torch.tensor([0.0, 1.0, 0.5, 1.0])[None, :, None, None].repeat(1, 1, 2, 2)
    images[:, 3, 0, 0] = 0
    colors = grey_background(images)
    assert torch.equal(colors[0, :, 0, 0], torch.zeros(3))
    assert torch.equal(colors[0, :, 1, 1], torch.tensor([-1.0, 1.0, 0.0]))
