"""ResNet-18 (He et al. 2016) as an image encoder, with the parameter names of torchvision's resnet18.

torchvision itself is no dependency, as it has no build for every PyTorch that nmr supports.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learn3d.files import formats, sandbox

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class _Block(nn.Module):
    """Two 3x3 convolutions beside a shortcut: relu(f(x) + x); x passes a 1x1 convolution if its size changes."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(x)) + shortcut)


class ResNet18Encoder(nn.Module):
    """Images [B, 4, 224, 224] in [0, 1] -> shape codes [B, 512]: the average-pooled features, which are not negative.

    R, G, B are normalised by ImageNet's mean and deviation; the mask is not read. The pooled features are the code, as
    in the published code of Peng et al. 2020 on Pascal3D+. inverted: images hold 1 - colour (Kato's files); natural
    colours are restored first.
    """

    image_size = 224

    def __init__(self, inverted: bool = False) -> None:
        super().__init__()
        self.inverted = inverted
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)
        self.conv1 = nn.Conv2d(3, 64, 7, 2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = nn.Sequential(_Block(64, 64, 1), _Block(64, 64, 1))
        self.layer2 = nn.Sequential(_Block(64, 128, 2), _Block(128, 128, 1))
        self.layer3 = nn.Sequential(_Block(128, 256, 2), _Block(256, 256, 1))
        self.layer4 = nn.Sequential(_Block(256, 512, 2), _Block(512, 512, 1))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):  # torchvision's initialisation
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def features(self, images: Tensor) -> Tensor:
        """The last features [B, 512, 7, 7], before they are pooled."""
        colors = 1 - images[:, :3] if self.inverted else images[:, :3]
        x = (colors - self.mean) / self.std
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x))), 3, 2, padding=1)
        return self.layer4(self.layer3(self.layer2(self.layer1(x))))

    def forward(self, images: Tensor) -> Tensor:
        return self.features(images).mean(dim=(2, 3))


class FlatResNet18(nn.Module):
    """Images [B,4,S,S] in [0,1] -> shape code [B,512]: a linear layer on the 512 * (S/32)^2 features of ResNet-18.

    The encoder of Kato and Harada 2019 for Pascal3D+. inverted: see `ResNet18Encoder`. frozen_norms: statistics, gain
    and offset of the batch norms do not change, as published for ImageNet weights.
    """

    def __init__(self, image_size: int = 224, frozen_norms: bool = False, inverted: bool = False) -> None:
        super().__init__()
        self.image_size = image_size
        self.resnet = ResNet18Encoder(inverted)
        self.code = nn.Linear(512 * (image_size // 32) ** 2, 512)
        self.frozen_norms: list[nn.BatchNorm2d] = []
        if frozen_norms:
            self.frozen_norms = [module for module in self.resnet.modules() if isinstance(module, nn.BatchNorm2d)]
            for norm in self.frozen_norms:
                norm.requires_grad_(False)
            self.train()

    def train(self, mode: bool = True) -> FlatResNet18:
        super().train(mode)
        for norm in self.frozen_norms:
            norm.eval()
        return self

    def forward(self, images: Tensor) -> Tensor:
        return self.code(self.resnet.features(images).flatten(1))


def check_pretrained(path: Path | None, encoder: str) -> None:
    """Raise a ValueError if pretrained weights are given for an encoder (by its name) that takes none."""
    if path is not None and encoder != "resnet18":
        raise ValueError(
            f"pretrained weights are for the encoder 'resnet18', got encoder {encoder!r}; choose that encoder (it "
            "takes images of 224 pixels), or leave pretrained out"
        )


def load_pretrained(encoder: nn.Module, path: Path | str) -> None:
    """Copy weights of torchvision's resnet18 (.pth, .pt or .safetensors) into a `ResNet18Encoder`, in place.

    The classification layer "fc" is left out. Nothing in the file is executed (weights_only).

    Raises FileNotFoundError if the file is missing, ValueError if it cannot be read or has weights of another network
    (naming the first that is missing, unknown or wrong).
    """
    path = Path(path)
    wanted = "weights of torchvision's resnet18"
    read = sandbox.read(formats.read_state_dict, path, wanted=wanted, **formats.WEIGHTS_LIMITS)
    given = {name: torch.from_numpy(value) for name, value in read.items() if not name.startswith("fc.")}
    own = encoder.state_dict()
    counters = {name for name in own if name.endswith("num_batches_tracked")}  # not in files of older versions
    hint = "; it must be a state dict of torchvision's resnet18"
    for word, names in (
        ("lacks", own.keys() - counters - given.keys()),
        ("has the unknown", given.keys() - own.keys()),
    ):
        if names:
            raise ValueError(f"{path} {word} entry {min(names)!r} and {len(names) - 1} more{hint}")
    for name, value in given.items():
        if value.shape != own[name].shape or value.is_floating_point() == (name in counters):
            wanted = f"{list(own[name].shape)} {own[name].dtype}"
            raise ValueError(f"{path}: {name} is {list(value.shape)} {value.dtype}, ResNet-18 has {wanted}{hint}")
        if not bool(value.to(own[name].dtype).isfinite().all()):
            raise ValueError(f"{path}: {name} has values that are not finite{hint}")
    encoder.load_state_dict(given, strict=False)
