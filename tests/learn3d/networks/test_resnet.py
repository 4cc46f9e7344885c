"""ResNet-18: torchvision's names and shapes, its arithmetic written out slowly, and weights from files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from steps import make_method
from torch import Tensor

from learn3d.data.dataset import DatasetInfo
from learn3d.files import limits
from learn3d.methods.pose_invariant import PoseInvariantSettings
from learn3d.networks.resnet import IMAGENET_MEAN, IMAGENET_STD, ResNet18Encoder, load_pretrained


def random_weights(counters: bool = True) -> dict[str, Tensor]:
    """Weights as torchvision's resnet18 has them, its layer of classes included."""
    torch.manual_seed(0)
    encoder = ResNet18Encoder()
    encoder.train()(torch.rand(4, 4, 64, 64))  # the batch norms see something
    with torch.no_grad():
        for weight in encoder.parameters():
            weight += 0.05 * torch.randn_like(weight)
    weights = encoder.state_dict() | {
        "fc.weight": torch.zeros(1000, 512),
        "fc.bias": torch.zeros(1000),
    }
    return {k: w for k, w in weights.items() if counters or not k.endswith("num_batches_tracked")}


def slow_resnet(images: Tensor, w: dict[str, Tensor]) -> Tensor:
    """The published architecture as formulas on a state dict, in evaluation mode."""

    def norm(x: Tensor, name: str) -> Tensor:
        parts = ("running_mean", "running_var", "weight", "bias")
        return F.batch_norm(x, *(w[f"{name}.{part}"] for part in parts))

    mean, std = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]])[..., None, None]
    x = (images[:, :3] - mean) / std
    x = norm(F.conv2d(x, w["conv1.weight"], stride=2, padding=3), "bn1").clamp(min=0)
    x = F.max_pool2d(x, 3, stride=2, padding=1)
    for layer in range(1, 5):
        for block in (0, 1):
            name, stride = f"layer{layer}.{block}", 2 if layer > 1 and block == 0 else 1
            y = F.conv2d(x, w[f"{name}.conv1.weight"], stride=stride, padding=1)
            y = F.conv2d(norm(y, f"{name}.bn1").clamp(min=0), w[f"{name}.conv2.weight"], padding=1)
            y = norm(y, f"{name}.bn2")
            if stride == 2:
                x = F.conv2d(x, w[f"{name}.downsample.0.weight"], stride=2)
                x = norm(x, f"{name}.downsample.1")
            x = (x + y).clamp(min=0)
    return x.flatten(2).mean(2)


def test_there_are_as_many_weights_as_torchvision_has() -> None:
    """Their names are those that `slow_resnet` reads: all but the counters of 20 batch norms."""
    encoder = ResNet18Encoder()
    assert len(encoder.state_dict()) == 100 + 20
    assert sum(p.numel() for p in encoder.parameters()) == 11_689_512 - 1000 * 513


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
def test_it_sees_natural_colours_of_every_layout(inverted: bool) -> None:
    """A red pixel reaches the first convolution as ImageNet's red, whether it is stored as red or as 255 - red."""
    stored = torch.zeros(1, 4, 224, 224, dtype=torch.uint8)
    stored[:, 0], stored[:, 3] = 255, 255
    stored[:, :3] = 255 - stored[:, :3] if inverted else stored[:, :3]
    method = make_method(
        PoseInvariantSettings(encoder="resnet18"), DatasetInfo(3, inverted=inverted)
    )
    seen = []
    method.encoder.conv1.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
    with torch.no_grad():
        method.encode(stored)
    red = (torch.eye(3)[0] - torch.tensor(IMAGENET_MEAN)) / torch.tensor(IMAGENET_STD)
    torch.testing.assert_close(seen[0][0, :, 7, 11], red)


def test_a_method_starts_from_pretrained_weights(tmp_path: Path) -> None:
    weights, path = random_weights(), tmp_path / "weights.pth"
    torch.save(weights, path)
    settings = PoseInvariantSettings(encoder="resnet18", symmetry="z", pretrained=str(path))
    assert settings.pretrained == path
    method = make_method(settings, DatasetInfo(3, inverted=False, pose_features=9))
    method.start_from_pretrained()
    assert torch.equal(method.encoder.conv1.weight, weights["conv1.weight"])


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
