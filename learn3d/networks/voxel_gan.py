"""PrGAN's networks (Gadelha et al. 2017): voxel generator, projection, silhouette discriminator,
inverse encoder.

Layers, sizes and initial weights are those of the published TensorFlow code: weights of fully
connected layers from N(0, 0.1), of convolutions from N(0, 0.02), biases 0. TensorFlow's momentum
of 0.9 in batch norms is torch's 0.1.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import nmr

SHAPE_CODE = 200  # entries of z for the shape; one more entry decides the view
SILHOUETTE_SIZE = 64
TAU = 0.5  # factor of the density in the projection; a full voxel has density 1 / TAU and lets exp(-1) of light pass
GENERATOR_CHANNELS = (128, 64, 32, 1)
DISCRIMINATOR_CHANNELS = (128, 256, 512, 1024)


class VoxelGenerator(nn.Module):
    """Shape code [B, 200] -> density float32 [B, 64, 64, 64] in [0, 1 / TAU], axes (x, y, z) of
    the object frame.

    A linear layer to `channels[0]` features on 4^3 cells, then transposed convolutions that double the
    cells, to the other channels and to one at 64^3; batch norm and ReLU after all but the last, which has a sigmoid.
    The published code has one channel already at 32^3, perhaps by mistake: its batch norm there
    is declared for 16.
    """

    def __init__(self, channels: Sequence[int] = GENERATOR_CHANNELS) -> None:
        super().__init__()
        self.first = nn.Linear(SHAPE_CODE, channels[0] * 4**3)
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise((*channels, 1)):
            doubling = nn.ConvTranspose3d(before, after, 4, stride=2, padding=1)
            layers += [nn.BatchNorm3d(before), nn.ReLU(), doubling]
        self.layers = nn.Sequential(*layers)
        self.apply(_initialise)
        self.to(memory_format=torch.channels_last_3d)  # half the time on a CPU

    def forward(self, codes: Tensor) -> Tensor:
        features = self.first(codes).reshape(len(codes), -1, 4, 4, 4)
        return (
            torch.sigmoid(self.layers(features.to(memory_format=torch.channels_last_3d)))[:, 0]
            / TAU
        )


class SilhouetteDiscriminator(nn.Module):
    """Silhouettes [B, 64, 64] in [0, 1] -> logits [B]: positive for silhouettes of the data set.

    5x5 convolutions of stride 2 to four `channels`, batch norm and LeakyReLU(0.2) after each,
    then a linear layer.
    """

    def __init__(self, channels: Sequence[int] = DISCRIMINATOR_CHANNELS) -> None:
        super().__init__()
        self.first, *others = (
            nn.Sequential(
                nn.Conv2d(before, after, 5, stride=2, padding=2),
                nn.BatchNorm2d(after),
                nn.LeakyReLU(0.2),
            )
            for before, after in itertools.pairwise((1, *channels))
        )
        self.others = nn.Sequential(*others)
        self.last = nn.Linear(channels[-1] * (SILHOUETTE_SIZE // 16) ** 2, 1)
        self.apply(_initialise)
        self.to(memory_format=torch.channels_last)

    def forward(self, silhouettes: Tensor) -> Tensor:
        return self.last(self.others(self.first(silhouettes[:, None])).flatten(1))[:, 0]


class InverseEncoder(nn.Module):
    """Silhouettes [B, 64, 64] in [0, 1] -> z [B, 201]: the shape code, then the view's entry.

    4096-512-512-201, with LeakyReLU(0.2) after the first layer only and the output divided by
    201, as published.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(SILHOUETTE_SIZE**2, 512),
            nn.LeakyReLU(0.2),
            nn.Linear(512, 512),
            nn.Linear(512, SHAPE_CODE + 1),
        )
        self.apply(_initialise)

    def forward(self, silhouettes: Tensor) -> Tensor:
        return self.layers(silhouettes.flatten(1)) / (SHAPE_CODE + 1)


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.normal_(module.weight, std=0.1)
    elif isinstance(module, nn.ConvTranspose3d):
        nn.init.normal_(module.weight, std=0.02)
    elif isinstance(module, nn.Conv2d):
        nn.init.trunc_normal_(module.weight, std=0.02, a=-0.04, b=0.04)
    else:
        return
    nn.init.zeros_(module.bias)


@dataclass(frozen=True)
class ViewCircle:
    """K views at equal steps of azimuth, as in Kato's protocol: view k has azimuth -360 k / K
    degrees.

    Rays are parallel, as PrGAN's. The image covers `half_width` to each side of the origin, so
    that objects have the same size as in the data set's perspective images.
    """

    count: int = 24
    elevation_deg: float = 30.0
    distance: float = 2.732
    half_fov_deg: float = 15.0

    @property
    def half_width(self) -> float:
        """Half of the image's side, in units of the object frame: 0.732 for Kato's camera."""
        return self.distance * math.tan(math.radians(self.half_fov_deg))

    def azimuth_deg(self, view_ids: Tensor) -> Tensor:
        """Azimuths of the views `view_ids`, float32, in degrees."""
        return view_ids.float() * (-360.0 / self.count)


def project(density: Tensor, view_ids: Tensor, views: ViewCircle, tau: float) -> Tensor:
    """Soft silhouettes P = 1 - exp(-tau * integral of the density along the ray), float32 [B, S,
    S], row 0 = top.

    density: float32 [B, S, S, S] at the voxel centres of the box [-0.5, 0.5]^3, axes (x, y, z) of
    the object frame, trilinear in between, zero outside. view_ids: int64 [B] in 0 .. K-1. The
    integral is in voxels: a solid of density 1 and a thickness of n voxels gives 1 - exp(-tau n).
    Differentiable in the density.

    As in the published code the volume is resampled in the camera's frame and summed along the
    depth. Samples are as far apart as pixels, and cover the diagonal of the box.
    """
    size = density.shape[-1]
    width = 2 * views.half_width
    depth = math.ceil(math.sqrt(3.0) * size / width)
    cameras = nmr.LookAt.from_angles(
        views.distance, views.elevation_deg, views.azimuth_deg(view_ids.cpu())
    )
    # Coordinates of grid_sample begin with the last axis and go from -1 to 1. Sums of three tables
    # take a quarter of the time of affine_grid.
    right, down, forward = cameras.projection().matrix[:, None, :, :3].flip(3).to(density).unbind(2)
    across, along = (
        ((2 * torch.arange(n) + 1 - n) * (width / size)).to(density)[:, None] for n in (size, depth)
    )
    rows = (forward * along)[:, :, None] + (down * across)[:, None]
    grid = rows[:, :, :, None] + (right * across)[:, None, None]
    samples = F.grid_sample(density[:, None], grid, align_corners=False)
    return 1 - torch.exp(-tau * width * samples.sum((1, 2)))
