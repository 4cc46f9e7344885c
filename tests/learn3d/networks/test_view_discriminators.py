"""Discriminators of silhouettes and views."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from learn3d.networks.discriminators import (
    OneHotViewDiscriminator,
    PatchDiscriminator,
    SpectralPatchDiscriminator,
)
from learn3d.networks.layers import reverse_gradient


def convolutions(network: nn.Module) -> list[tuple]:
    layers = [m for m in network.modules() if isinstance(m, nn.Conv2d)]
    return [(c.in_channels, c.out_channels, c.kernel_size[0], c.stride[0], c.padding[0]) for c in layers]


def test_dcgan_is_as_published() -> None:
    network = OneHotViewDiscriminator(24)
    assert convolutions(network) == [
        (25, 128, 4, 2, 1),
        (128, 256, 4, 2, 1),
        (256, 512, 4, 2, 1),
        (512, 1024, 4, 2, 1),
    ]
    assert [m.num_features for m in network.modules() if isinstance(m, nn.BatchNorm2d)] == [256, 512, 1024]
    assert {m.negative_slope for m in network.modules() if isinstance(m, nn.LeakyReLU)} == {0.2}
    assert network.layers[-1].in_features == 1024 * 4 * 4


def test_dcgan_sees_silhouette_and_view() -> None:
    network = OneHotViewDiscriminator(5, channels=4).eval()
    seen = []
    network.layers[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    silhouettes = torch.rand(2, 64, 64)
    logits = network(silhouettes, torch.tensor([0, 3]))
    assert logits.shape == (2,)
    expected = torch.zeros(2, 6, 64, 64)
    expected[:, 0], expected[0, 1], expected[1, 4] = silhouettes, 1, 1
    assert torch.equal(seen[0], expected)
    assert not torch.isclose(network(silhouettes, torch.tensor([1, 3]))[0], logits[0])


def test_spectral_patch_is_as_published() -> None:
    network = SpectralPatchDiscriminator(3)
    widths = [(1, 32), (64, 64), (64, 128), (128, 256), (256, 256), (256, 1)]
    assert convolutions(network) == [(a, b, 5, 2, 2) for a, b in widths]
    norms = [m for m in network.modules() if isinstance(m, (nn.BatchNorm1d, nn.BatchNorm2d))]
    assert sorted(m.num_features for m in norms) == [32, 32, 64, 128, 256, 256]
    assert all(not m.weight.requires_grad and m.bias.requires_grad for m in norms)
    with torch.no_grad():
        assert network(torch.rand(2, 224, 224), torch.rand(2, 3)).shape == (2, 4, 4)


def test_every_weight_of_spectral_patch_has_spectral_norm_1() -> None:
    torch.manual_seed(0)
    network = SpectralPatchDiscriminator(3, channels=8, num_classes=4)
    for _ in range(20):  # one power iteration each
        network(torch.rand(2, 64, 64), torch.rand(2, 3), torch.tensor([0, 1]))
    layers = [m for m in network.modules() if isinstance(m, (nn.Conv2d, nn.Linear))]
    assert len(layers) == 8
    network.eval()
    for layer in layers:
        assert float(torch.linalg.matrix_norm(layer.weight.detach().flatten(1), 2)) == pytest.approx(1, abs=0.05)


def test_patch_is_as_published() -> None:
    network = PatchDiscriminator(9)
    strides = [(1, 64, 2), (128, 128, 2), (128, 256, 2), (256, 512, 1), (512, 1, 1)]
    assert convolutions(network) == [(a, b, 4, stride, 2) for a, b, stride in strides]
    assert not [m for m in network.modules() if isinstance(m, (nn.BatchNorm1d, nn.BatchNorm2d))]
    narrow = PatchDiscriminator(9, channels=4)
    assert narrow(torch.rand(2, 224, 224), torch.rand(2, 9)).shape == (2, 31, 31)


def test_class_conditioning_is_a_projection_on_the_last_features() -> None:
    torch.manual_seed(0)
    network = SpectralPatchDiscriminator(3, channels=4, num_classes=3).eval()
    features, plain = [], []
    network.layers.register_forward_hook(lambda _, __, output: features.append(output))
    network.last.register_forward_hook(lambda _, __, output: plain.append(output))
    silhouettes, views = torch.rand(2, 224, 224), torch.rand(2, 3)
    logits = network(silhouettes, views, torch.tensor([0, 2]))
    assert logits.shape == (2, 4, 4)
    assert features[0].shape == (2, 32, 7, 7)
    vectors = network.classes.weight.T[torch.tensor([0, 2])]
    product = (vectors[:, :, None, None] * features[0]).sum(1)
    torch.testing.assert_close(logits, plain[0][:, 0] + product[:, ::2, ::2])
    assert not torch.allclose(network(silhouettes, views, torch.tensor([1, 2]))[0], logits[0])


def test_gradient_reversal_has_sign_and_scale() -> None:
    values = torch.randn(3, requires_grad=True)
    reversed_values = reverse_gradient(values, 0.25)
    assert torch.equal(reversed_values, values)
    (reversed_values * torch.tensor([1.0, -2, 4])).sum().backward()
    assert torch.equal(values.grad, torch.tensor([-0.25, 0.5, -1]))
