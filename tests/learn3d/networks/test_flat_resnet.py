"""ResNet-18 with a linear layer on all its features."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

from learn3d.networks.flat_resnet import FlatResNet18
from learn3d.networks.resnet import ResNet18Encoder, load_pretrained


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """Weights with batch norms that are not the initial ones."""
    torch.manual_seed(0)
    encoder = ResNet18Encoder()
    for module in encoder.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.running_mean, -0.1, 0.1)
            nn.init.uniform_(module.weight, 0.5, 1.0)
    path = tmp_path_factory.mktemp("weights") / "resnet18.pth"
    torch.save(encoder.state_dict(), path)
    return path


def start(network: FlatResNet18, weights: Path) -> FlatResNet18:
    load_pretrained(network.resnet, weights)
    return network


def norms(network: nn.Module) -> list[nn.BatchNorm2d]:
    return [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]


def test_codes_are_linear_in_the_features(weights: Path) -> None:
    network = start(FlatResNet18(64, frozen_norms=True), weights).eval()
    plain = ResNet18Encoder().eval()
    plain.load_state_dict(torch.load(weights))
    images = torch.rand(2, 4, 64, 64)
    features = []
    network.resnet.layer4.register_forward_hook(lambda _, __, output: features.append(output))
    codes = network(images)
    assert codes.shape == (2, 512)
    torch.testing.assert_close(features[0].mean((2, 3)), plain(images))
    torch.testing.assert_close(codes, features[0].flatten(1) @ network.code.weight.T + network.code.bias)
    assert FlatResNet18().code.in_features == 512 * 7 * 7


def test_pretrained_batch_norms_stay_as_they_are(weights: Path) -> None:
    network = start(FlatResNet18(32, frozen_norms=True), weights).train()
    assert not any(norm.training or norm.weight.requires_grad for norm in norms(network))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    optimizer = torch.optim.SGD([p for p in network.parameters() if p.requires_grad], lr=0.1)
    network(torch.rand(2, 4, 32, 32)).square().sum().backward()
    optimizer.step()
    after = network.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert "resnet.conv1.weight" in changed
    assert not [name for name in changed if "bn" in name or "downsample.1" in name]


def test_size_must_be_a_multiple_of_32() -> None:
    with pytest.raises(ValueError, match="multiple of 32 for FlatResNet18, got 100"):
        FlatResNet18(100)
