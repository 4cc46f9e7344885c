"""ResNet-18 with a linear layer on all its features (Kato and Harada 2019, Pascal3D+)."""

from __future__ import annotations

from torch import Tensor, nn

from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.resnet import ResNet18Encoder


class FlatResNet18(nn.Module):
    """Images [B,4,S,S] in [0,1], the mask unused -> shape code [B,512], linear in the 512 * (S/32)^2 last features.

    `inverted`: the images hold 1 - colour, see `ResNet18Encoder`.

    `frozen_norms`: statistics, gain and offset of the batch norms stay as they are, as published for weights of
    ImageNet. In training from scratch, frozen batch norms would normalise nothing.
    """

    def __init__(self, image_size: int = 224, frozen_norms: bool = False, inverted: bool = False) -> None:
        super().__init__()
        self.image_size = image_size
        self.resnet = ResNet18Encoder(inverted)
        self.code = nn.Linear(512 * (image_size // 32) ** 2, CODE_SIZE)
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
