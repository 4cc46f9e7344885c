"""A pre-activation ResNet-18, trained from scratch (Kato and Harada 2019, ShapeNet)."""

from __future__ import annotations

from torch import Tensor, nn

from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.layers import initialize_he

BATCH_NORM_EPS = 2e-5  # published code


class PreactResNet18(nn.Module):
    """Images [B,4,S,S] in [0,1], laid over grey -> shape code [B,512], unbounded.

    As published: 7x7 convolution of stride 2, batch norm, ReLU, 3x3 maximum of stride 2; four stages of two blocks with
    64, 128, 256, 512 channels, in which batch norm and ReLU come before each convolution; batch norm, ReLU; a linear
    layer from all 512 * (S/32)^2 features, without pooling. He's initial weights. The published size is S = 224; here
    any multiple of 32 is possible (S decides the size of the last layer).
    """

    def __init__(self, image_size: int = 224, channels: int = 64) -> None:
        super().__init__()
        self.image_size = image_size
        widths = [channels, 2 * channels, 4 * channels, 8 * channels]
        blocks: list[nn.Module] = []
        for before, width in zip([channels, *widths[:-1]], widths, strict=True):
            blocks += [_Block(before, width, first=not blocks), _Block(width, width)]
        self.layers = nn.Sequential(
            nn.Conv2d(3, channels, 7, stride=2, padding=3, bias=False),
            nn.BatchNorm2d(channels, eps=BATCH_NORM_EPS),
            nn.ReLU(),
            nn.MaxPool2d(3, stride=2, ceil_mode=True),
            *blocks,
            nn.BatchNorm2d(widths[-1], eps=BATCH_NORM_EPS),
            nn.ReLU(),
            nn.Flatten(),
        )
        initialize_he(self)
        self.code = nn.Linear(widths[-1] * (image_size // 32) ** 2, CODE_SIZE)

    def forward(self, images: Tensor) -> Tensor:
        return self.code(self.layers(grey_background(images)))


class _Block(nn.Module):
    """x + f(x): two 3x3 convolutions, batch norm and ReLU before each (the first block's input has had its own).

    If the number of channels changes, the first convolution and a 1x1 convolution in place of x have stride 2.
    """

    def __init__(self, before: int, after: int, first: bool = False) -> None:
        super().__init__()
        stride = 1 if before == after else 2
        activation = [] if first else [nn.BatchNorm2d(before, eps=BATCH_NORM_EPS), nn.ReLU()]
        self.residual = nn.Sequential(
            *activation,
            nn.Conv2d(before, after, 3, stride=stride, padding=1, bias=False),
            nn.BatchNorm2d(after, eps=BATCH_NORM_EPS),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1, bias=False),
        )
        self.shortcut = nn.Identity() if stride == 1 else nn.Conv2d(before, after, 1, stride=2, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        return self.shortcut(features) + self.residual(features)


def grey_background(images: Tensor) -> Tensor:
    """RGB and mask [B,4,S,S] in [0,1] -> colours [B,3,S,S] in [-1,1], 0 (grey) if the mask is 0.

    Inverted colours (Kato's files) come out with the other sign. To a network trained from scratch that is the same.
    """
    return (2 * images[:, :3] - 1) * images[:, 3:]
