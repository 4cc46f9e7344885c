"""Pictures of shapes in rows: the grid shown during training, the comparison of runs, and walks between shapes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.conventions import view_poses
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.methods import Method
from learn3d.methods.surfaces import grid_surface
from learn3d.pictures.sheets import TILE, magnify, natural_colors, tile
from learn3d.pictures.surfaces import azimuths_deg, common_zoom, draw_surface, orbit

TURNS_DEG = (0, 60, 120, 180, 240, 300)
TILE_SIZE = 128  # pixels of a picture in a comparison
AZIMUTHS_DEG = (-135.0, -45.0)  # viewpoints of an interpolation, oblique for whichever axis the object faces
FRAMES = 16  # of an interpolation from one image to the next
STRIP_STEPS = 4  # of them in its strip; divides FRAMES
FRAME_SIZE = 192  # pixels
_AROUND = [f"+{turn}°" for turn in TURNS_DEG[1:]]


@torch.no_grad()
def picture_grid(method: Method, dataset: ViewDataset, indices: Tensor) -> np.ndarray:
    """Inputs and results of a method in training: uint8 [H,W,3].

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
    for i, (vertices, faces, _) in enumerate(shapes):
        pose = view_poses(torch.zeros(1)) if batch.poses is None else batch.poses[torch.tensor([i])]
        rendering = torch.zeros(MASK_SIZE, MASK_SIZE)
        if len(faces):
            rendering = nmr.render_silhouette(vertices[None], faces, pose.cameras(), image_size=MASK_SIZE)[0]
        greys = (torch.stack([batch.masks[i], rendering]).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        views = draw_surface(shapes[i], orbit(pose, TURNS_DEG), image_size=TILE)
        rows.append([inputs[i], *np.repeat(greys[..., None], 3, axis=-1), *views])
    return tile(rows, ["input", "target", "rendering", "same view", *_AROUND])


@torch.no_grad()
def comparison_grid(
    methods: Sequence[tuple[str, Method]],
    dataset: ViewDataset,
    samples: Tensor,
    *,
    truth: bool = False,
    title: str = "input",
) -> np.ndarray:
    """The same images through several methods, each a (label, method): uint8 [H,W,3].

    A group of rows per image: the input, and a row per method with its shape from the input's view and from five more
    around the object. `title` stands above the inputs. All pictures are magnified alike, as far as the shapes allow.
    With `truth` the objects' voxels come first; raises ValueError if they are not known.
    """
    batch = dataset.batch(samples)
    shown = [(label, method.decode(method.encode(batch.images)).surfaces()) for label, method in methods]
    if truth:
        if dataset.voxels is None:
            raise ValueError(f"{dataset.category}, {dataset.split} has no true voxels to show")
        voxels = dataset.convention.to_object(batch.voxels.float())
        shown.insert(0, ("truth", [grid_surface(grid, box=dataset.convention.cube_side) for grid in voxels]))
    poses = [dataset.poses[sample[None]] for sample in samples]
    cameras = [orbit(pose, TURNS_DEG) for pose in poses]
    zoom = common_zoom([pair for _, shapes in shown for pair in zip(shapes, cameras, strict=True)], batch.masks)
    inputs = magnify(natural_colors(batch.images.numpy(), inverted=dataset.inverted), zoom)
    rows = []
    for i, pose in enumerate(poses):
        nearer = orbit(pose, TURNS_DEG, zoom=zoom)
        pictures = [draw_surface(shapes[i], nearer, image_size=TILE_SIZE) for _, shapes in shown]
        rows += [[inputs[i] if k == 0 else None, *row] for k, row in enumerate(pictures)]
    labels = [label for label, _ in shown] * len(samples)
    rules = range(len(shown), len(rows), len(shown))
    return tile(rows, [title, "input view", *_AROUND], tile_size=TILE_SIZE, row_titles=labels, rules=rules)


def walk(codes: Tensor) -> Tensor:
    """Codes on an endless walk from each of `codes` [n, C] to the next in `FRAMES` equal steps: [n * FRAMES, C]."""
    share = torch.arange(FRAMES, dtype=codes.dtype, device=codes.device)[:, None] / FRAMES
    return torch.lerp(codes[:, None], codes.roll(-1, 0)[:, None], share).flatten(0, 1)


@torch.no_grad()
def interpolate(
    method: Method, dataset: ViewDataset, samples: Tensor, *, title: str = "input"
) -> tuple[np.ndarray, np.ndarray]:
    """The way from the shape of each image `samples` int64 [n] to that of the next: (strip, frames).

    strip uint8 [H,W,3] has the images, each over its own reconstruction, and a row per viewpoint with (n - 1) * 4 + 1
    shapes; `title` stands before the images. frames uint8 [n * 16,2,S,S,3] are seen from the same two viewpoints and go
    on to the first image again. Raises ValueError for fewer than two images.
    """
    if len(samples) < 2:
        raise ValueError(f"an interpolation takes at least two images, got {len(samples)}")
    batch, pose = dataset.batch(samples), dataset.poses[samples[:1]]
    shapes = method.decode(walk(method.encode(batch.images))).surfaces()
    turns = [azimuth - float(azimuths_deg(pose)[0]) for azimuth in AZIMUTHS_DEG]
    cameras = orbit(pose, turns)
    zoom = common_zoom([(surface, cameras) for surface in shapes], batch.masks)
    cameras = orbit(pose, turns, zoom=zoom)
    frames = np.stack([draw_surface(surface, cameras, image_size=FRAME_SIZE) for surface in shapes])
    in_strip = frames[: (len(samples) - 1) * FRAMES + 1 : FRAMES // STRIP_STEPS]
    inputs: list[np.ndarray | None] = [None] * len(in_strip)
    inputs[::STRIP_STEPS] = magnify(natural_colors(batch.images.numpy(), inverted=dataset.inverted), zoom)
    titles = [title, *(f"azimuth {azimuth:g}°" for azimuth in AZIMUTHS_DEG)]
    return tile([inputs, *in_strip.swapaxes(0, 1)], row_titles=titles), frames
