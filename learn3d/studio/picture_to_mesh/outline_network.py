"""A small network that finds the main object in a photograph."""

import functools
import math
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
import torch.nn.functional as F
from PIL import Image
from scipy import ndimage
from scipy.special import expit
from torch import Tensor, nn

from learn3d.networks.layers import norm_relu

SIDES = 128, 160, 192  # sides in pixels of the pictures that the network sees
VIEW = SIDES[-1]  # side in pixels of its answer
MARGIN = 0.2  # of the background around an object in its view, as a share of the object's sides
NARROW = 0.6  # least ratio of a view's shorter side to its longer one, before it becomes a square
WEIGHTS = Path(__file__).with_name("outlines.safetensors")  # made by tools/train_outlines.py

Place = tuple[float, float, float, float]  # left, top, right, bottom in pixels
Part = tuple[int, int, int, int]  # the same, of a part of a picture


class OutlineNetwork(nn.Module):
    """Pictures float [B, 4, S, S] -> logits [B, S, S] of the object's pixels; S is a multiple of 32.

    The channels are R, G, B in 0 .. 1, and 1 where the object may be. It is a U-Net (Ronneberger
    et al. 2015) that starts and ends with blocks of two by two pixels and adds its skips.
    """

    def __init__(self, widths: tuple[int, ...] = (16, 40, 80, 120, 144)) -> None:
        super().__init__()
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        before = 16  # four channels of two by two pixels
        for number, width in enumerate(widths):
            first = _convolution(before, width, stride=min(2, 1 + number))
            self.down.append(nn.Sequential(*first, *_convolution(width, width)))
            before = width
        for width in widths[-2::-1]:
            self.up.append(nn.Sequential(*_convolution(before, width)))
            before = width
        self.last = nn.Sequential(*_convolution(before, before), nn.Conv2d(before, 4, 3, padding=1))

    def forward(self, pictures: Tensor) -> Tensor:
        features = F.pixel_unshuffle(pictures - 0.5, 2)
        skips = []
        for layers in self.down:
            features = layers(features)
            skips.append(features)
        for layers, skip in zip(self.up, skips[-2::-1], strict=True):
            features = skip + F.interpolate(layers(features), scale_factor=2, mode="bilinear")
        return F.pixel_shuffle(self.last(features), 2)[:, 0]


def _convolution(before: int, after: int, stride: int = 1) -> list[nn.Module]:
    return [nn.Conv2d(before, after, 3, stride, 1, bias=False), *norm_relu(after)]


@functools.lru_cache(1)
def load_outline_network() -> OutlineNetwork:
    """The network of the package, for inference."""
    network = OutlineNetwork()
    network.load_state_dict(safetensors.torch.load_file(WEIGHTS))
    return network.eval()


def find_object(colors: np.ndarray, box: Place | None = None) -> tuple[Part, np.ndarray]:
    """Find the main object of a picture uint8 [H, W, 3]: a view around it, and the logits [S, S] of that view.

    With a box, it is the object that fills the box. Otherwise the network looks at the whole
    picture first, and then at the surroundings of the object that it saw.
    """
    height, width = colors.shape[:2]
    whole = 0, 0, width, height
    view = place_view(box or _place(_look(colors, whole), width, height), width, height)
    return view, _look(colors, view, box)


def place_view(place: Place, width: int, height: int) -> Part:
    """The part of a picture that the network sees: the object's place and `MARGIN` around it, within the picture."""
    left, top, right, bottom = place
    wide, high = (1 + 2 * MARGIN) * (right - left), (1 + 2 * MARGIN) * (bottom - top)
    wide, high = max(wide, NARROW * high, 2) / 2, max(high, NARROW * wide, 2) / 2
    x, y = (left + right) / 2, (top + bottom) / 2
    return (
        max(0, math.floor(x - wide)),
        max(0, math.floor(y - high)),
        min(width, math.ceil(x + wide)),
        min(height, math.ceil(y + high)),
    )


def _place(logits: np.ndarray, width: int, height: int) -> Place:
    """The box of the object in a picture: of the regions above half of the largest probability, the one with most."""
    inside = expit(logits)
    regions, count = ndimage.label(inside > min(0.5, inside.max() / 2))
    best = np.argmax(ndimage.sum(inside, regions, np.arange(1, count + 1)))
    rows, columns = ndimage.find_objects(regions)[best]
    x, y = width / VIEW, height / VIEW
    return x * columns.start, y * rows.start, x * columns.stop, y * rows.stop


@torch.no_grad()
def _look(colors: np.ndarray, view: Part, box: Place | None = None) -> np.ndarray:
    """Logits [S, S] of a part of a picture; the object may be anywhere in it, or in the box.

    They are the mean over several sizes and over mirror images.
    """
    left, top, right, bottom = view
    box = box or view
    part, answers = Image.fromarray(colors).crop(view), []
    for side in SIDES:
        columns = left + (np.arange(side) + 0.5) * (right - left) / side
        rows = top + (np.arange(side)[:, None] + 0.5) * (bottom - top) / side
        allowed = (columns > box[0]) & (columns < box[2]) & (rows > box[1]) & (rows < box[3])
        seen = np.float32(part.resize((side, side), Image.Resampling.BOX)) / 255
        picture = torch.from_numpy(np.dstack([seen, allowed.astype(np.float32)])).movedim(-1, 0)
        logits = load_outline_network()(torch.stack([picture, picture.flip(-1)]))
        logits = (logits[:1] + logits[1:].flip(-1)) / 2
        answers.append(F.interpolate(logits[None], (VIEW, VIEW), mode="bilinear"))
    return torch.cat(answers).mean(dim=0)[0].numpy()
