"""Inputs beside what methods make of them: the grid shown during training, and the comparison of several runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.conventions import view_poses
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.poses import wrap_deg
from learn3d.methods import Method
from learn3d.methods.surfaces import grid_surface
from learn3d.pictures.sheets import TILE, magnify, natural_colors, tile, to_uint8
from learn3d.pictures.surfaces import Surface, azimuths_deg, common_zoom, draw_surface, orbit

TURNS_DEG = (0, 60, 120, 180, 240, 300)
GRID_COLUMNS = ("input", "target", "rendering", "same view", *(f"+{turn}°" for turn in TURNS_DEG[1:]))
_SPREAD_DEG = 137.508  # the golden angle: any number of directions, none near another


@torch.no_grad()
def picture_grid(method: Method, dataset: ViewDataset, indices: Tensor) -> np.ndarray:
    """What a method makes of some images: uint8 [H,W,3].

    A row per image: the input, the target silhouette, the rendered silhouette and the shaded shape at the input's view,
    and the shape from five new views around it.
    """
    batch = dataset.batch(indices)
    training = method.training
    method.set_training(False)
    shapes = method.decode(method.encode(batch.images)).surfaces()
    method.set_training(training)
    inputs = natural_colors(batch.images.numpy(), inverted=dataset.inverted)
    rows = []
    for i, surface in enumerate(shapes):
        pose = view_poses(torch.zeros(1)) if batch.poses is None else batch.poses[torch.tensor([i])]
        flat = [inputs[i], to_uint8(batch.masks[i]), to_uint8(_silhouette(surface, pose.cameras()))]
        rows.append([*flat, *draw_surface(surface, orbit(pose, TURNS_DEG), image_size=TILE)])
    return tile(rows, GRID_COLUMNS)


@torch.no_grad()
def comparison_grid(
    methods: Sequence[tuple[str, Method]],
    dataset: ViewDataset,
    samples: Tensor,
    *,
    truth: bool = False,
    title: str = "",
    tile_size: int = TILE,
) -> np.ndarray:
    """The same images through several methods, each a (label, method): uint8 [H,W,3].

    A group of rows per image: the input, and a row per method with its shape from the input's view and from five more
    around the object. `title` stands above the inputs. All pictures are magnified alike, as far as the shapes allow.
    With `truth` the objects' voxels come first, like a method of that name.
    """
    if not methods:
        raise ValueError("give at least one method to compare")
    if truth and dataset.voxels is None:
        raise ValueError(f"{dataset.category}, {dataset.split} has no true voxels to show")
    batch = dataset.batch(samples)
    poses = [batch.poses[torch.tensor([i])] for i in range(len(samples))]
    shapes = {label: method.decode(method.encode(batch.images)).surfaces() for label, method in methods}
    if truth:
        grids = dataset.convention.to_object(batch.voxels.float())
        true_shapes = [grid_surface(grid, box=dataset.convention.box) for grid in grids]
        shapes = {"truth": true_shapes, **shapes}
    if len(shapes) < len(methods) + truth:
        raise ValueError(f"the methods need different labels, got {[label for label, _ in methods]}")
    cameras = [orbit(pose, TURNS_DEG) for pose in poses]
    zoom = common_zoom([pair for of_one in shapes.values() for pair in zip(of_one, cameras, strict=True)], batch.masks)
    cameras = [orbit(pose, TURNS_DEG, zoom=zoom) for pose in poses]
    inputs = list(magnify(natural_colors(batch.images.numpy(), inverted=dataset.inverted), zoom))
    drawn = {  # label -> pictures [6, S, S, 3] of each image
        label: [draw_surface(s, c, image_size=tile_size) for s, c in zip(of_one, cameras, strict=True)]
        for label, of_one in shapes.items()
    }
    titles = ("input view", *(f"+{turn}°" for turn in TURNS_DEG[1:]))
    rows = [
        [inputs[i] if k == 0 else None, *pictures[i]]
        for i in range(len(samples))
        for k, pictures in enumerate(drawn.values())
    ]
    labels = list(drawn) * len(samples)
    rules = range(len(shapes), len(rows), len(shapes))
    return tile(rows, [title or "input", *titles], tile_size=tile_size, row_titles=labels, rules=rules)


def spread_views(dataset: ViewDataset, count: int) -> Tensor:
    """`count` different samples for a figure, int64 [count]: objects spread evenly, each from another side.

    A function of the data set alone. Raises ValueError where there are not so many samples.
    """
    if not 1 <= count <= len(dataset):
        raise ValueError(f"the data set has {len(dataset)} images, {count} were asked for")
    azimuths = azimuths_deg(dataset.poses).numpy()
    present = np.unique(dataset.object_ids)
    places = np.arange(count)
    objects = present[places * len(present) // count if count <= len(present) else places % len(present)]
    chosen: list[int] = []
    for k, number in enumerate(objects):
        left = np.setdiff1d(np.flatnonzero(dataset.object_ids == number), chosen)
        if len(left) == 0:  # an object with few views was asked for more
            left = np.setdiff1d(np.arange(len(dataset)), chosen)
        off = wrap_deg(torch.from_numpy(azimuths[left] - 30 - k * _SPREAD_DEG)).abs()
        chosen.append(int(left[int(off.argmin())]))
    return torch.tensor(chosen)


def _silhouette(surface: Surface, camera: nmr.cameras.Camera) -> Tensor:
    """Coverage of the pixels, float32 [64, 64]."""
    if len(surface.faces) == 0:
        return torch.zeros(MASK_SIZE, MASK_SIZE)
    return nmr.render_silhouette(surface.vertices[None], surface.faces, camera, image_size=MASK_SIZE)[0]
