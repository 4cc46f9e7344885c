"""ResNet-18 (He et al. 2016) as an image encoder, with the parameter names of torchvision's
resnet18.

torchvision itself is no dependency, as it has no build for every PyTorch that nmr supports.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut: relu(f(x) + x); x passes a 1x1 convolution if its
    size changes.
    """

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample = None
        if inputs != outputs:
            self.downsample = nn.Sequential(
                nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)
            )

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(x)) + shortcut)


class ResNet18Encoder(nn.Module):
    """Images [B, 4, S, S] in [0, 1] -> shape codes [B, 512].

    R, G, B are normalised by ImageNet's mean and deviation; the mask is not read. inverted:
    images hold 1 - colour (Kato's files); natural colours are restored first. The code is the
    average of the last features, which is not negative, as in the published code of Peng et al.
    2020 on Pascal3D+ (S = 224).
    """

    image_size = 224

    def __init__(self, inverted: bool = False) -> None:
        super().__init__()
        self.inverted = inverted
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)
        self.conv1 = nn.Conv2d(3, 64, 7, 2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.layer1 = nn.Sequential(ResidualBlock(64, 64), ResidualBlock(64, 64))
        self.layer2 = nn.Sequential(ResidualBlock(64, 128, 2), ResidualBlock(128, 128))
        self.layer3 = nn.Sequential(ResidualBlock(128, 256, 2), ResidualBlock(256, 256))
        self.layer4 = nn.Sequential(ResidualBlock(256, 512, 2), ResidualBlock(512, 512))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):  # torchvision's initialisation
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, images: Tensor) -> Tensor:
        colors = 1 - images[:, :3] if self.inverted else images[:, :3]
        x = (colors - self.mean) / self.std
        x = F.max_pool2d(F.relu(self.bn1(self.conv1(x))), 3, 2, padding=1)
        return self.layer4(self.layer3(self.layer2(self.layer1(x)))).mean(dim=(2, 3))


def load_pretrained(encoder: ResNet18Encoder, path: Path | str) -> None:
    """Copy weights of torchvision's resnet18 (.pth, .pt or .safetensors) into an encoder, in place.

    The layer "fc" of the file is left out. Nothing in the file is executed (weights_only).

    Raises FileNotFoundError if the file is missing, ValueError if it cannot be read or has
    weights of another network.
    """
    # here, as a training without pretrained weights reads no such file
    from learn3d.files import (
        formats,
        sandbox,
    )

    read = sandbox.read(formats.read_state_dict, path, wanted="weights of torchvision's resnet18")
    weights = {
        name: torch.from_numpy(value) for name, value in read.items() if not name.startswith("fc.")
    }
    try:
        encoder.load_state_dict(weights)
        if odd := [
            name for name, value in encoder.state_dict().items() if not value.isfinite().all()
        ]:
            raise RuntimeError(f"{odd[0]} is not finite")
    except RuntimeError as error:
        message = textwrap.shorten(str(error), 300)
        raise ValueError(
            f"{path} must be a state dict of torchvision's resnet18: {message}"
        ) from None
