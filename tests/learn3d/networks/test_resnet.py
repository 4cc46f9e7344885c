"""Both ResNets-18: torchvision's names and shapes, its arithmetic written out slowly, and weights from files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from learn3d.data.dataset import DatasetInfo
from learn3d.files import limits
from learn3d.methods.pose_invariant import PoseInvariant, PoseInvariantSettings
from learn3d.methods.vpl import VPL, VPLSettings
from learn3d.networks.resnet import IMAGENET_MEAN, IMAGENET_STD, ResNet18Encoder, load_pretrained


def torchvision_names() -> dict[str, tuple[int, ...]]:
    """Entries and shapes of torchvision's resnet18, the classification layer included."""

    def norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
        vectors = {
            f"{name}.{part}": (width,) for part in ("weight", "bias", "running_mean", "running_var")
        }
        return vectors | {f"{name}.num_batches_tracked": ()}

    names = (
        {"conv1.weight": (64, 3, 7, 7)}
        | norm("bn1", 64)
        | {"fc.weight": (1000, 512), "fc.bias": (1000,)}
    )
    inputs = 64
    for layer, width in enumerate((64, 128, 256, 512), 1):
        for block in (0, 1):
            prefix = f"layer{layer}.{block}"
            names |= {
                f"{prefix}.conv1.weight": (width, inputs, 3, 3),
                f"{prefix}.conv2.weight": (width, width, 3, 3),
            }
            names |= norm(f"{prefix}.bn1", width) | norm(f"{prefix}.bn2", width)
            if inputs != width:
                names |= {f"{prefix}.downsample.0.weight": (width, inputs, 1, 1)} | norm(
                    f"{prefix}.downsample.1", width
                )
            inputs = width
    return names


def random_weights(seed: int = 0, counters: bool = True) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    weights = {}
    for name, shape in torchvision_names().items():
        if name.endswith("num_batches_tracked"):
            weights |= {name: torch.tensor(7)} if counters else {}
        elif name.endswith("running_var"):
            weights[name] = torch.rand(shape, generator=generator) + 0.5
        else:
            scale = (
                (2 / max(1, torch.tensor(shape[1:]).prod().item())) ** 0.5
                if len(shape) > 1
                else 0.2
            )
            weights[name] = scale * torch.randn(shape, generator=generator)
    return weights


def slow_resnet(images: Tensor, w: dict[str, Tensor]) -> Tensor:
    """The published architecture as formulas on a state dict, in evaluation mode."""

    def norm(x: Tensor, name: str) -> Tensor:
        mean, var, weight, bias = (
            w[f"{name}.{part}"][:, None, None]
            for part in ("running_mean", "running_var", "weight", "bias")
        )
        return (x - mean) / (var + 1e-5).sqrt() * weight + bias

    x = images[:, :3] - torch.tensor([0.485, 0.456, 0.406])[:, None, None]
    x = x / torch.tensor([0.229, 0.224, 0.225])[:, None, None]
    x = norm(F.conv2d(x, w["conv1.weight"], stride=2, padding=3), "bn1").clamp(min=0)
    x = F.max_pool2d(x, 3, stride=2, padding=1)
    for layer in range(1, 5):
        for block in (0, 1):
            name, stride = f"layer{layer}.{block}", 2 if layer > 1 and block == 0 else 1
            y = norm(
                F.conv2d(x, w[f"{name}.conv1.weight"], stride=stride, padding=1), f"{name}.bn1"
            ).clamp(min=0)
            y = norm(F.conv2d(y, w[f"{name}.conv2.weight"], padding=1), f"{name}.bn2")
            if stride == 2:
                x = norm(
                    F.conv2d(x, w[f"{name}.downsample.0.weight"], stride=2), f"{name}.downsample.1"
                )
            x = (x + y).clamp(min=0)
    return x.flatten(2).mean(2)


def test_names_and_shapes_are_torchvisions() -> None:
    own = {name: tuple(value.shape) for name, value in ResNet18Encoder().state_dict().items()}
    assert own == {
        name: shape for name, shape in torchvision_names().items() if not name.startswith("fc.")
    }


@pytest.mark.parametrize("form", ["pth", "pt, without counters", "safetensors"])
def test_weights_from_a_file_give_the_published_networks_output(tmp_path: Path, form: str) -> None:
    weights = random_weights(counters="without" not in form)
    path = tmp_path / f"weights.{form.split(',')[0]}"
    save_file(weights, path) if form == "safetensors" else torch.save(weights, path)
    encoder = ResNet18Encoder()
    load_pretrained(encoder, path)
    images = torch.rand(2, 4, 64, 64)
    with torch.no_grad():
        codes = encoder.eval()(images)
    assert codes.shape == (2, 512)
    torch.testing.assert_close(codes, slow_resnet(images, weights), rtol=1e-3, atol=1e-3)
    assert (codes >= 0).all() and codes.std() > 0.01
    changed = images.clone()
    changed[:, 3] = 0
    assert torch.equal(encoder(images), encoder(changed))  # the mask is not looked at


@pytest.mark.parametrize("inverted", [True, False])
@pytest.mark.parametrize("kind", ["pooled", "flat"])
def test_it_sees_natural_colours_of_every_layout(kind: str, inverted: bool) -> None:
    """A red pixel reaches the first convolution as ImageNet's red, whether it is stored as red or as 255 - red."""
    stored = torch.zeros(1, 4, 224, 224, dtype=torch.uint8)
    stored[:, 0], stored[:, 3] = 255, 255
    stored[:, :3] = 255 - stored[:, :3] if inverted else stored[:, :3]
    kinds = {
        "pooled": (PoseInvariant, PoseInvariantSettings(encoder="resnet18")),
        "flat": (VPL, VPLSettings(encoder="resnet18", image_size=224)),
    }
    create, settings = kinds[kind]
    method = create(settings, DatasetInfo(3, inverted=inverted), "cpu", "fp32")
    seen = []
    method.encoder.conv1.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
    with torch.no_grad():
        method.encode(stored)
    red = (torch.tensor([1.0, 0.0, 0.0]) - torch.tensor(IMAGENET_MEAN)) / torch.tensor(IMAGENET_STD)
    torch.testing.assert_close(seen[0][0, :, 7, 11], red)


def test_a_method_starts_from_pretrained_weights(tmp_path: Path) -> None:
    weights = random_weights()
    torch.save(weights, tmp_path / "weights.pth")
    settings = PoseInvariantSettings(
        encoder="resnet18", symmetry="z", pretrained=str(tmp_path / "weights.pth")
    )
    assert settings.pretrained == tmp_path / "weights.pth"
    method = PoseInvariant(settings, DatasetInfo(3, inverted=False, pose_features=9), "cpu", "fp32")
    method.start_from_pretrained()
    assert torch.equal(method.encoder.conv1.weight, weights["conv1.weight"])
    with pytest.raises(
        ValueError,
        match=r"for the encoder 'resnet18', got encoder 'conv-small'; choose that encoder",
    ):
        PoseInvariantSettings(encoder="conv-small", pretrained=tmp_path / "weights.pth")


class Runs:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return open, ("ran", "w")


def test_wrong_weights_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    encoder, path, weights = ResNet18Encoder(), tmp_path / "w.pth", random_weights()

    def refused(content: object, message: str) -> None:
        torch.save(content, path)
        with pytest.raises(ValueError, match=message):
            load_pretrained(encoder, path)

    hint = "must be a state dict of torchvision's resnet18"
    refused(
        {k: v for k, v in weights.items() if "layer4" not in k},
        f"w.pth {hint}: .*Missing key.*layer4",
    )
    refused(
        weights | {"layer4.2.conv1.weight": torch.ones(1)},
        f"{hint}: .*Unexpected key.*layer4.2.conv1.weight",
    )
    refused(weights | {"bn1.bias": torch.ones(3)}, rf"{hint}: .*bn1.bias: .*\[3\]\).*\[64\]\)")
    for value in (float("nan"), 1e300):
        bias = torch.full((64,), value, dtype=torch.float64)
        refused(weights | {"bn1.bias": bias}, f"{hint}: bn1.bias is not finite")
    bias = weights["bn1.bias"]
    for odd in (bias.to(torch.float8_e4m3fn), bias.to("meta"), bias.to_sparse()):
        refused(weights | {"bn1.bias": odd}, r"w\.pth: cannot be read")
    refused(weights | {5: torch.ones(1)}, 'Unexpected key.* "5"')
    refused([1, 2], r"w.pth: must hold a state dict \(names -> tensors\), got list")
    refused(weights | {"bn1.bias": Runs()}, "w.pth: cannot be read .*Weights only load failed")
    assert not Path("ran").exists()
    for name in ("w.pth", "w.safetensors"):
        Path(name).write_bytes(b"no weights")
        with pytest.raises(ValueError, match=f"{name}: cannot be read"):
            load_pretrained(encoder, tmp_path / name)
    with pytest.raises(FileNotFoundError, match=r"none.pth: is missing"):
        load_pretrained(encoder, tmp_path / "none.pth")

    with open(path, "wb") as file:
        file.truncate(limits.WEIGHTS_BYTES + 1)
    with pytest.raises(ValueError, match=r"w\.pth: has \d+ bytes; the limit is"):
        load_pretrained(encoder, path)


def test_flat_resnet_is_linear_in_the_features_and_keeps_pretrained_batch_norms(
    tmp_path: Path,
) -> None:
    torch.save(random_weights(), tmp_path / "w.pth")
    network, plain = ResNet18Encoder(flat_size=64, frozen_norms=True), ResNet18Encoder().eval()
    load_pretrained(network, tmp_path / "w.pth")
    load_pretrained(plain, tmp_path / "w.pth")
    images, features = torch.rand(2, 4, 64, 64), []
    network.layer4.register_forward_hook(lambda _, __, output: features.append(output))
    codes = network.train()(images)
    torch.testing.assert_close(features[0].mean((2, 3)), plain(images))
    torch.testing.assert_close(
        codes, features[0].flatten(1) @ network.code.weight.T + network.code.bias
    )
    assert network.code.in_features == 512 * 2 * 2

    before = {name: value.clone() for name, value in network.state_dict().items()}
    codes.square().sum().backward()
    torch.optim.SGD([p for p in network.parameters() if p.requires_grad], lr=0.1).step()
    changed = {
        name for name, value in network.state_dict().items() if not torch.equal(before[name], value)
    }
    assert "conv1.weight" in changed
    assert not [name for name in changed if "bn" in name or "downsample.1" in name]
