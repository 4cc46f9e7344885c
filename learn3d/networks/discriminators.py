"""Discriminators of shape codes (pose-invariant method) and of silhouettes (view prior learning).

Those of silhouettes take silhouettes float [B,S,S] and their views, and return logits: positive
for "rendered at the view of the input image".
"""

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.layers import BATCH_NORM_EPS, initialize_he, linear_layers

SLOPE = 0.2  # slope of the leaky ReLUs


def pose_discriminator(num_views: int) -> nn.Sequential:
    """Shape code [B,512] -> logits [B,K] over K view classes."""
    return linear_layers(CODE_SIZE, 256, 128, num_views)


class OneHotViewDiscriminator(nn.Module):
    """DCGAN's discriminator on a silhouette and a one-hot plane for each of K views -> logits [B].

    Four 4x4 convolutions of stride 2 with c, 2c, 4c, 8c channels, batch norm on the last three,
    leaky ReLUs, and a linear layer; c = 128 in the published code of Peng et al. 2020 for S = 64.
    """

    def __init__(self, num_views: int, channels: int = 128, silhouette_size: int = 64) -> None:
        super().__init__()
        self.num_views = num_views
        layers: list[nn.Module] = [
            nn.Conv2d(1 + num_views, channels, 4, stride=2, padding=1),
            nn.LeakyReLU(SLOPE),
        ]
        for before in (channels, 2 * channels, 4 * channels):
            convolution = nn.Conv2d(before, 2 * before, 4, stride=2, padding=1)
            layers += [convolution, nn.BatchNorm2d(2 * before), nn.LeakyReLU(SLOPE)]
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(8 * channels * (silhouette_size // 16) ** 2, 1)
        )

    def forward(self, silhouettes: Tensor, view_ids: Tensor) -> Tensor:
        planes = F.one_hot(view_ids, self.num_views).to(silhouettes)
        return self.layers(_append(silhouettes.unsqueeze(1), planes)).squeeze(1)


class SpectralPatchDiscriminator(nn.Module):
    """ "shapenet_patch" of Kato and Harada 2019: one logit per patch, [B,S/64,S/64] rounded up
    (4x4 for S = 224).

    5x5 convolutions of stride 2 with c, 2c, 4c, 8c, 8c channels (c = 32), each with spectral
    normalisation, batch norm without gain and leaky ReLU. After the first one, c channels of view
    features are appended (a linear layer with the same normalisations). A last 5x5 convolution
    gives the logits. `num_classes` conditions them on the class by projection (Miyato and Koyama
    2018): the product of a learned vector of the class with the last features.
    """

    def __init__(
        self, view_features: int, channels: int = 32, num_classes: int | None = None
    ) -> None:
        super().__init__()
        self.first = nn.Sequential(
            _spectral_conv(1, channels), *_norm_without_gain(nn.BatchNorm2d(channels))
        )
        self.view = nn.Sequential(
            spectral_norm(nn.Linear(view_features, channels, bias=False)),
            *_norm_without_gain(nn.BatchNorm1d(channels)),
        )
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(
            (2 * channels, 2 * channels, 4 * channels, 8 * channels, 8 * channels)
        ):
            layers += [_spectral_conv(before, after), *_norm_without_gain(nn.BatchNorm2d(after))]
        self.layers = nn.Sequential(*layers)
        self.last = _spectral_conv(8 * channels, 1, bias=True)
        self.num_classes = num_classes
        if num_classes is not None:
            self.classes = spectral_norm(nn.Linear(num_classes, 8 * channels, bias=False))

    def forward(
        self, silhouettes: Tensor, views: Tensor, class_ids: Tensor | None = None
    ) -> Tensor:
        """`views` float [B,C]; `class_ids` int64 [B], only with `num_classes`."""
        features = self.layers(_append(self.first(silhouettes.unsqueeze(1)), self.view(views)))
        logits = self.last(features).squeeze(1)
        if self.num_classes is None:
            return logits
        # One-hot vectors, not an embedding: spectral_norm normalises the weight of a linear layer.
        classes = self.classes(F.one_hot(class_ids, self.num_classes).to(features))
        product = torch.einsum("bc,bchw->bhw", classes, features)
        return logits + product[:, ::2, ::2]


class PatchDiscriminator(nn.Module):
    """ "pascal_patch" of Kato and Harada 2019: one logit per patch, [B,h,w]; no normalisation of
    any kind.

    4x4 convolutions with c (stride 2), 2c (2), 4c (2), 8c (1) and 1 (1) channels (c = 64), leaky
    ReLUs. After the first one, c channels of view features are appended (linear layer, leaky
    ReLU). He's initial weights.
    """

    def __init__(self, view_features: int, channels: int = 64) -> None:
        super().__init__()
        self.first = nn.Sequential(
            nn.Conv2d(1, channels, 4, stride=2, padding=2), nn.LeakyReLU(SLOPE)
        )
        self.view = nn.Sequential(nn.Linear(view_features, channels), nn.LeakyReLU(SLOPE))
        layers: list[nn.Module] = []
        for before, after, stride in ((2, 2, 2), (2, 4, 2), (4, 8, 1)):
            layers += [nn.Conv2d(before * channels, after * channels, 4, stride=stride, padding=2)]
            layers += [nn.LeakyReLU(SLOPE)]
        self.layers = nn.Sequential(*layers, nn.Conv2d(8 * channels, 1, 4, padding=2))
        initialize_he(self)

    def forward(self, silhouettes: Tensor, views: Tensor) -> Tensor:
        """`views` float [B,C]."""
        return self.layers(_append(self.first(silhouettes.unsqueeze(1)), self.view(views))).squeeze(
            1
        )


def _append(features: Tensor, view: Tensor) -> Tensor:
    """[B,C,H,W] and [B,D] -> [B,C+D,H,W]."""
    return torch.cat([features, view[:, :, None, None].expand(-1, -1, *features.shape[2:])], dim=1)


def _spectral_conv(before: int, after: int, bias: bool = False) -> nn.Module:
    return spectral_norm(nn.Conv2d(before, after, 5, stride=2, padding=2, bias=bias))


def _norm_without_gain(norm: nn.BatchNorm1d | nn.BatchNorm2d) -> list[nn.Module]:
    """Batch norm without gain, which would undo the spectral normalisation, and leaky ReLU."""
    norm.eps = BATCH_NORM_EPS
    norm.weight.requires_grad_(False)
    return [norm, nn.LeakyReLU(SLOPE)]
