"""Walks through the space of shapes: strips and animations between the codes of some images (paper, interpolation)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from learn3d.data.dataset import ViewDataset
from learn3d.data.poses import Poses, wrap_deg
from learn3d.figures.runs import encode
from learn3d.methods import Method
from learn3d.pictures.sheets import TILE, magnify, natural_colors, tile
from learn3d.pictures.surfaces import Surface, azimuths_deg, common_zoom, draw_surface, orbit

AZIMUTHS_DEG = (-135.0, -45.0)  # the two viewpoints, oblique for whichever axis the object faces


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
    legs = [(1 - share) * start + share * end for start, end in itertools.pairwise(ends)]
    return torch.cat(legs if closed else [*legs, codes[-1:]])


@torch.no_grad()
def interpolation_strip(
    method: Method,
    dataset: ViewDataset,
    samples: Tensor,
    *,
    steps: int = 4,
    azimuths: Sequence[float] = AZIMUTHS_DEG,
    title: str = "",
) -> np.ndarray:
    """The way from the shape of one image to that of the next, and on: uint8 [H,W,3].

    Above, the images `samples` int64 [n], each over its own reconstruction; below, a row per viewpoint (azimuth in
    degrees; elevation and distance of the first image's camera) with (n - 1) * steps + 1 shapes. `title` stands before
    the images.
    """
    batch = dataset.batch(samples)
    shapes = method.decode(walk(method.encode(batch.images), steps)).surfaces()
    pictures, zoom = _draw(shapes, batch.poses, batch.masks, azimuths, TILE)
    inputs: list[np.ndarray | None] = [None] * len(shapes)
    inputs[::steps] = list(magnify(natural_colors(batch.images.numpy(), inverted=dataset.inverted), zoom))
    titles = [title or "input", *(f"azimuth {azimuth:g}°" for azimuth in azimuths)]
    return tile([inputs, *pictures], row_titles=titles)


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
    """Frames of an endless walk through the shapes of the images `samples` int64 [n].

    uint8 [n * steps, len(azimuths), S, S, 3], S = `image_size`.
    """
    batch = dataset.batch(samples)
    shapes = method.decode(walk(method.encode(batch.images), steps, closed=True)).surfaces()
    pictures, _ = _draw(shapes, batch.poses, batch.masks, azimuths, image_size)
    return pictures.swapaxes(0, 1)


def _draw(
    shapes: Sequence[Surface], poses: Poses, masks: Tensor, azimuths: Sequence[float], image_size: int
) -> tuple[np.ndarray, float]:
    """(Pictures uint8 [len(azimuths), n, S, S, 3] of n shapes, magnified as far as shapes and masks allow; by what)."""
    if not azimuths:
        raise ValueError("an interpolation is seen from at least one azimuth, none was given")
    start = float(azimuths_deg(poses)[0])
    pose, turns = poses[torch.tensor([0])], [azimuth - start for azimuth in azimuths]
    cameras = orbit(pose, turns)
    zoom = common_zoom([(surface, cameras) for surface in shapes], masks)
    cameras = orbit(pose, turns, zoom=zoom)
    pictures = np.stack([draw_surface(surface, cameras, image_size=image_size) for surface in shapes])
    return pictures.swapaxes(0, 1), zoom


@torch.no_grad()
def typical_views(method: Method, dataset: ViewDataset, count: int, *, azimuth_deg: float = AZIMUTHS_DEG[0]) -> Tensor:
    """Samples of `count` objects whose shapes differ but are no oddities, int64 [count].

    Every object counts as the code of its view nearest to `azimuth_deg`; chosen are those nearest to the centres of
    `count` clusters of these codes (k-means, started with the farthest points), which are in the order of their size.
    """
    off = wrap_deg(azimuths_deg(dataset.poses) - azimuth_deg).abs()
    order = np.argsort(off.numpy(), kind="stable")
    _, first = np.unique(dataset.object_ids[order], return_index=True)
    samples = torch.from_numpy(order[first])
    if not 2 <= count <= len(samples):
        raise ValueError(f"an interpolation takes 2 to {len(samples)} images here (one an object), got {count}")
    codes = encode(method, dataset, samples)
    centres = codes[(codes - codes.mean(dim=0)).norm(dim=1).argmin()][None]
    while len(centres) < count:
        centres = torch.cat([centres, codes[torch.cdist(codes, centres).amin(dim=1).argmax()][None]])
    for _ in range(20):
        nearest = torch.cdist(codes, centres).argmin(dim=1)
        members = [codes[nearest == k] for k in range(count)]
        centres = torch.stack([m.mean(dim=0) if len(m) else c for m, c in zip(members, centres, strict=True)])
    distances = torch.cdist(centres, codes)
    chosen: list[int] = []
    for k in sorted(range(count), key=lambda k: -len(members[k])):
        chosen.append(next(i for i in distances[k].argsort().tolist() if i not in chosen))
    return samples[chosen]
