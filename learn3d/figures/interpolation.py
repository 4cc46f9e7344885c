"""Walks through the space of shapes: strips and animations between the codes of some images (paper, interpolation)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from learn3d.data.views import ViewDataset
from learn3d.figures.drawing import TILE, azimuths_deg, draw_surface, natural_colors, orbit, surfaces, tile
from learn3d.methods.method import Method

AZIMUTHS_DEG = (-30.0, 60.0)  # the two viewpoints: obliquely from the front, obliquely from the side


def walk(codes: Tensor, steps: int, *, closed: bool = False) -> Tensor:
    """Codes from the first of `codes` [n, C] to the last through all others, `steps` equal steps from each to the next.

    [(n - 1) * steps + 1, C]; entry k * steps is code k itself. `closed` goes on to the first and stops one step short
    of it: [n * steps, C], an endless loop.
    """
    if codes.ndim != 2 or len(codes) < 2:
        raise ValueError(f"a walk needs the codes [n, C] of at least two images, got {list(codes.shape)}")
    if steps < 1:
        raise ValueError(f"steps from one code to the next must be at least 1, got {steps}")
    ends = torch.cat([codes, codes[:1]]) if closed else codes
    share = torch.arange(steps, dtype=codes.dtype, device=codes.device)[:, None] / steps
    legs = [(1 - share) * start + share * end for start, end in zip(ends[:-1], ends[1:], strict=True)]
    return torch.cat(legs if closed else [*legs, codes[-1:]])


@torch.no_grad()
def draw_walk(
    method: Method, dataset: ViewDataset, samples: Tensor, codes: Tensor, azimuths: Sequence[float], image_size: int
) -> np.ndarray:
    """The shapes of some codes [n, C] from some azimuths in degrees: uint8 [n, len(azimuths), S, S, 3].

    Elevation, distance and field of view are those of the first of the `samples`.
    """
    pose = dataset.poses[samples[:1]]
    cameras = orbit(pose, [azimuth - float(azimuths_deg(pose)[0]) for azimuth in azimuths])
    shapes = surfaces(method.decode(codes))
    return np.stack([draw_surface(surface, cameras, image_size=image_size) for surface in shapes])


@torch.no_grad()
def interpolation_strip(
    method: Method,
    dataset: ViewDataset,
    samples: Tensor,
    *,
    steps: int = 4,
    azimuths: Sequence[float] = AZIMUTHS_DEG,
    tile_size: int = TILE,
) -> np.ndarray:
    """The way from the shape of one image to that of the next, and on: uint8 [H,W,3].

    Above, the images `samples` int64 [n], each over its own reconstruction; below, a row per viewpoint with
    (n - 1) * steps + 1 shapes.
    """
    batch = dataset.batch(samples)
    codes = walk(method.encode(batch.images), steps)
    pictures = draw_walk(method, dataset, samples, codes, azimuths, tile_size)
    inputs: list[np.ndarray | None] = [None] * len(codes)
    inputs[::steps] = list(natural_colors(batch.images.numpy(), inverted=dataset.inverted))
    titles = [f"azimuth {azimuth:g}°" for azimuth in azimuths]
    return tile([inputs, *pictures.swapaxes(0, 1)], tile_size=tile_size, row_titles=["input", *titles])


@torch.no_grad()
def morph(
    method: Method,
    dataset: ViewDataset,
    samples: Tensor,
    *,
    steps: int = 16,
    azimuths: Sequence[float] = AZIMUTHS_DEG,
    image_size: int = 192,
) -> np.ndarray:
    """Frames of an endless walk through the shapes of the images `samples` int64 [n], viewpoints side by side.

    uint8 [n * steps, S, len(azimuths) * S, 3].
    """
    codes = walk(method.encode(dataset.batch(samples).images), steps, closed=True)
    pictures = draw_walk(method, dataset, samples, codes, azimuths, image_size)
    return np.concatenate(list(pictures.swapaxes(0, 1)), axis=2)
