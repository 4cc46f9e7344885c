"""PrGAN's networks (Gadelha et al. 2017): voxel generator, silhouette discriminator, inverse encoder.

Layers, sizes and initial weights are those of the published TensorFlow code: weights of fully connected layers from
N(0, 0.1), of convolutions from N(0, 0.02), biases 0. TensorFlow's momentum of 0.9 in batch norms is torch's 0.1.
`channels` are four numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

SHAPE_CODE = 200  # number of entries of z for the shape; one more decides the view
IMAGE_SIZE = 64
TAU = 0.5  # a full voxel has density 1 / TAU, and the projection multiplies by TAU: exp(-1) passes through it
GENERATOR_CHANNELS = (128, 64, 32, 1)
DISCRIMINATOR_CHANNELS = (128, 256, 512, 1024)


class DoublingConvolution(nn.ConvTranspose3d):
    """[B, C, n, n, n] -> [B, C', 2n, 2n, 2n]: a transposed convolution of 4^3 weights with stride 2.

    To a single channel on a CPU, torch's own forward pass takes four times as long as that of `_Double`.
    """

    def __init__(self, before: int, after: int) -> None:
        super().__init__(before, after, 4, stride=2, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        if self.out_channels == 1 and features.device.type == "cpu":
            return _Double.apply(features, self.weight, self.bias)
        return super().forward(features)


class _Double(torch.autograd.Function):
    """Each of the eight cells that a cell becomes is a sum over 2^3 neighbours: one convolution with eight outputs.

    Along an axis, cell 2i is w[3] x[i-1] + w[1] x[i], and cell 2i + 1 is w[2] x[i] + w[0] x[i+1].
    """

    @staticmethod
    def forward(ctx, features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(features, weight)
        taps, n = torch.tensor([[3, 1], [2, 0]]), features.shape[-1]
        for axis in (2, 4, 6):  # 4 weights become [cell 0 or 1, neighbour 0 or 1]
            weight = weight.index_select(axis, taps.flatten()).unflatten(axis, (2, 2))
        kernel = weight[:, 0].permute(1, 3, 5, 0, 2, 4, 6).flatten(0, 2)
        cells = F.conv3d(features, kernel.contiguous(), bias.expand(8), padding=1)
        doubled = features.new_empty((len(features), 1, 2 * n, 2 * n, 2 * n))
        for number, (i, j, k) in enumerate(itertools.product((0, 1), repeat=3)):
            doubled[:, 0, i::2, j::2, k::2] = cells[:, number, i : i + n, j : j + n, k : k + n]
        return doubled

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        wanted = list(ctx.needs_input_grad)
        stride, padding, dilation, output_padding = [2, 2, 2], [1, 1, 1], [1, 1, 1], [0, 0, 0]
        return torch.ops.aten.convolution_backward(
            grad, *ctx.saved_tensors, [1], stride, padding, dilation, True, output_padding, 1, wanted
        )


class VoxelGenerator(nn.Module):
    """Shape code [B, 200] -> density float32 [B, 64, 64, 64] in [0, 1 / TAU], axes (x, y, z) of the object frame.

    A linear layer to `channels[0]` features on 4^3 cells, then transposed convolutions (4^3, stride 2) to the other
    channels at 8^3, 16^3 and 32^3 and to one at 64^3; batch norm and ReLU after all but the last, which has a sigmoid.
    The published layer list narrows to ONE channel already at 32^3, perhaps a slip: its normalisation there is declared
    for 16 channels. It stays the default, as in the published runs.
    """

    def __init__(self, channels: Sequence[int] = GENERATOR_CHANNELS) -> None:
        super().__init__()
        self.first = nn.Linear(SHAPE_CODE, channels[0] * 4**3)
        layers: list[nn.Module] = [nn.BatchNorm3d(channels[0]), nn.ReLU()]
        for before, after in itertools.pairwise(channels):
            layers += [DoublingConvolution(before, after), nn.BatchNorm3d(after), nn.ReLU()]
        layers.append(DoublingConvolution(channels[-1], 1))
        self.layers = nn.Sequential(*layers)
        self.apply(_initialise)
        self.to(memory_format=torch.channels_last_3d)  # half the time on a CPU

    def forward(self, codes: Tensor) -> Tensor:
        features = self.first(codes).reshape(len(codes), -1, 4, 4, 4)
        return torch.sigmoid(self.layers(features.to(memory_format=torch.channels_last_3d)))[:, 0] / TAU


class SilhouetteDiscriminator(nn.Module):
    """Grey silhouettes [B, 64, 64] in [0, 1] -> logits [B]: positive if they look like those of the data.

    Convolutions 5x5 with stride 2 to `channels`, batch norm and LeakyReLU(0.2) after each, then a linear layer.
    """

    def __init__(self, channels: Sequence[int] = DISCRIMINATOR_CHANNELS) -> None:
        super().__init__()
        layers = [
            nn.Sequential(nn.Conv2d(before, after, 5, stride=2, padding=2), nn.BatchNorm2d(after), nn.LeakyReLU(0.2))
            for before, after in itertools.pairwise((1, *channels))
        ]
        self.first, self.others = layers[0], nn.Sequential(*layers[1:])
        self.last = nn.Linear(channels[-1] * (IMAGE_SIZE // 16) ** 2, 1)
        self.apply(_initialise)
        self.to(memory_format=torch.channels_last)

    def forward(self, silhouettes: Tensor) -> Tensor:
        return self.last(self.others(self.first(silhouettes[:, None])).flatten(1))[:, 0]


class InverseEncoder(nn.Module):
    """Silhouettes [B, 64, 64] in [0, 1] -> z [B, 201]: the shape code, then the view's coordinate.

    4096-512-512-201 with a LeakyReLU(0.2) after the first layer only, and the output divided by 201, as published.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(IMAGE_SIZE**2, 512), nn.LeakyReLU(0.2), nn.Linear(512, 512), nn.Linear(512, SHAPE_CODE + 1)
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
