"""Discriminators of shape codes (pose-invariant method) and of silhouettes (view prior learning)."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.layers import linear_layers

SLOPE = 0.2  # slope of the leaky ReLUs


def pose_discriminator(num_views: int) -> nn.Sequential:
    """Shape code [B,512] -> logits [B,K] over K view classes."""
    return linear_layers(CODE_SIZE, 256, 128, num_views)


class OneHotViewDiscriminator(nn.Module):
    """DCGAN's discriminator on a silhouette [B,64,64] and a one-hot plane for each of K views ->
    logits [B], positive for "rendered at the view of the input image".

    Four 4x4 convolutions of stride 2 with c, 2c, 4c, 8c channels, batch norm on the last three,
    leaky ReLUs, and a linear layer; c = 128 in the published code of Peng et al. 2020.
    """

    def __init__(self, num_views: int, channels: int = 128) -> None:
        super().__init__()
        self.num_views = num_views
        layers: list[nn.Module] = [
            nn.Conv2d(1 + num_views, channels, 4, stride=2, padding=1),
            nn.LeakyReLU(SLOPE),
        ]
        for before in (channels, 2 * channels, 4 * channels):
            convolution = nn.Conv2d(before, 2 * before, 4, stride=2, padding=1)
            layers += [convolution, nn.BatchNorm2d(2 * before), nn.LeakyReLU(SLOPE)]
        self.layers = nn.Sequential(*layers, nn.Flatten(), nn.Linear(8 * channels * 4 * 4, 1))

    def forward(self, silhouettes: Tensor, view_ids: Tensor) -> Tensor:
        planes = F.one_hot(view_ids, self.num_views).to(silhouettes)[:, :, None, None]
        planes = planes.expand(-1, -1, *silhouettes.shape[1:])
        return self.layers(torch.cat([silhouettes[:, None], planes], dim=1)).squeeze(1)
