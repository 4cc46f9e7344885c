"""Image encoders: images -> shape codes."""

import itertools
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learn3d.networks.layers import initialize_he, linear_layers
from learn3d.networks.resnet import ResNet18Encoder

CODE_SIZE = 512
CENTRED_SIZE = 0.8  # object size (`ViewDataset.object_sizes`) after `centre`


class ConvEncoder(nn.Module):
    """Image [B,4,64,64] (RGB and mask, float in [0,1]) -> shape code [B,512] (no ReLU at the end).

    inverted: whether the data set stores colours as 1 - colour. Encoders take colours as they are
    stored, but for those that say otherwise.
    """

    image_size = 64
    channels: tuple[int, ...] = (64, 128, 256)
    hidden_sizes: tuple[int, ...] = (1024, 1024)

    def __init__(self, inverted: bool = True) -> None:
        super().__init__()
        self.convolutions = _convolutions(*self.channels)
        self.layers = linear_layers(
            self.channels[-1] * (self.image_size // 8) ** 2, *self.hidden_sizes, CODE_SIZE
        )

    def forward(self, images: Tensor) -> Tensor:
        # The last ReLU follows the change of memory layout; before it, its gradient would take 9 ms of a 270 ms step.
        features = self.convolutions[:-1](images).flatten(1)
        return self.layers(self.convolutions[-1](features))


class SmallConvEncoder(ConvEncoder):
    """1.3 million weights instead of 19, for small data sets and quick experiments. Unpublished."""

    channels, hidden_sizes = (16, 32, 64), (256,)


class LightConvEncoder(ConvEncoder):
    """ConvEncoder with half the channels and a 1x1 convolution to 32 channels before the linear
    layers. Unpublished.

    3.9 million weights, not 19. With torch's initial weights the codes of the first hundred steps
    hardly depend on the image: mode collapse may follow, so the convolutions get He's. A white
    background has the same effect, so colours that are not `inverted` (stored as 1 - colour over
    black) are inverted first.
    """

    def __init__(self, inverted: bool = True) -> None:
        nn.Module.__init__(self)
        self.inverted = inverted
        narrow = 32
        self.convolutions = _convolutions(32, 64, 128).extend(
            [nn.Conv2d(128, narrow, 1), nn.ReLU()]
        )
        self.layers = linear_layers(
            narrow * (self.image_size // 8) ** 2, *self.hidden_sizes, CODE_SIZE
        )
        initialize_he(self.convolutions)

    def forward(self, images: Tensor) -> Tensor:
        return super().forward(images if self.inverted else _on_black(images))


class CentredConvEncoder(LightConvEncoder):
    """LightConvEncoder with two more convolutions, one hidden layer and scaled input: all objects
    have one size.

    A cut-out picture does not show the camera's distance. With this encoder training images do
    not show it either, so the size of an object is learnt from its appearance. 2.0 million
    weights. Unpublished.
    """

    hidden_sizes = (576,)

    def __init__(self, inverted: bool = True) -> None:
        super().__init__(inverted)
        for position in (6, 8):  # before the 1x1 convolution
            self.convolutions.insert(position, nn.Conv2d(128, 128, 3, padding=1))
            self.convolutions.insert(position + 1, nn.ReLU())
        initialize_he(self.convolutions)

    def forward(self, images: Tensor) -> Tensor:
        return super().forward(centre(images))


class ViewClassifier(nn.Module):
    """Images [B,4,64,64], as for an encoder -> logits [B,K] over K view classes.

    Objects are scaled to one size.

    0.2 million weights. Unpublished.
    """

    def __init__(self, num_views: int, inverted: bool) -> None:
        super().__init__()
        self.inverted = inverted
        self.convolutions = _convolutions(16, 32, 64).extend(
            [nn.Conv2d(64, 64, 3, stride=2, padding=1), nn.ReLU()]
        )
        self.layers = linear_layers(64 * 4 * 4, 128, num_views)
        initialize_he(self.convolutions)

    def forward(self, images: Tensor) -> Tensor:
        images = centre(images if self.inverted else _on_black(images))
        return self.layers(self.convolutions(images).flatten(1))


def centre(images: Tensor, object_size: float = CENTRED_SIZE) -> Tensor:
    """Scale and shift images float [B,C,S,S], the mask last, so that the mask's bounding box is
    centred and its longer side takes `object_size` of the image. Beyond the border, colours are
    repeated and the mask is 0. Images with an empty mask do not change.
    """
    size = images.shape[-1]
    inside = images[:, -1] > 0.5
    extents, middles = [], []
    for axis in (1, 2):
        touched = inside.any(axis)
        # `last` is excluded
        first = touched.int().argmax(1)
        last = size - touched.flip(1).int().argmax(1)
        extents.append(last - first)
        middles.append((first + last) / size - 1)
    scale = torch.maximum(*extents) / (size * object_size)
    steps = (torch.arange(size, device=images.device) + 0.5) * (2 / size) - 1
    x, y = (scale[:, None] * steps + middle[:, None] for middle in middles)
    grid = torch.stack(torch.broadcast_tensors(x[:, None, :], y[:, :, None]), dim=-1)
    centred = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
    centred[:, -1] *= grid.abs().amax(-1) < 1
    return torch.where(inside.any((1, 2))[:, None, None, None], centred, images)


def _on_black(images: Tensor) -> Tensor:
    """Images [B,4,S,S] with their colours inverted, so that a white background is 0."""
    return torch.cat([1 - images[:, :3], images[:, 3:]], dim=1)


def _convolutions(*channels: int) -> nn.Sequential:
    """5x5 convolutions of stride 2, each with ReLU, from four channels to `channels`."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise((4, *channels)):
        layers += [nn.Conv2d(before, after, 5, stride=2, padding=2), nn.ReLU()]
    return nn.Sequential(*layers)


EncoderName = Literal["conv", "conv-light", "conv-small", "conv-centred", "resnet18"]
ENCODERS: dict[str, type[ConvEncoder] | type[ResNet18Encoder]] = {
    "conv": ConvEncoder,
    "conv-light": LightConvEncoder,
    "conv-small": SmallConvEncoder,
    "conv-centred": CentredConvEncoder,
    "resnet18": ResNet18Encoder,
}


def network_input(
    images: Tensor,
    device: torch.device | str,
    size: int = 64,
    memory_format: torch.memory_format = torch.channels_last,
) -> Tensor:
    """Stored images uint8 [B,4,size,size] -> float32 in [0,1] on `device`, in this layout."""
    if images.dtype != torch.uint8 or images.ndim != 4 or images.shape[1:] != (4, size, size):
        raise ValueError(
            f"images must be uint8 [B, 4, {size}, {size}] (RGB and mask), got {images.dtype} {list(images.shape)}"
        )
    images = images.to(device, non_blocking=True)
    pixels = torch.empty(images.shape, device=images.device, memory_format=memory_format)
    for channel in range(4):  # one pass converts and copies; torch's own change of layout is slower
        pixels[:, channel].copy_(images[:, channel])
    return pixels.div_(255)
