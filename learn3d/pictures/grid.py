"""The grid of pictures that a training draws."""

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.conventions import view_poses
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.methods.method import Method
from learn3d.pictures.sheets import TILE, natural_colors, tile
from learn3d.pictures.surfaces import draw_surface, orbit

TURNS_DEG = (0, 60, 120, 180, 240, 300)  # views of a shape, counted from the input's view
AROUND = [f"+{turn}°" for turn in TURNS_DEG[1:]]


@torch.no_grad()
def picture_grid(method: Method, dataset: ViewDataset, indices: Tensor) -> np.ndarray:
    """Inputs and results of a method in training: uint8 [H,W,3].

    A row per image: the input, the target silhouette, the rendered silhouette and the shaded shape at the input's view,
    and the shape from five more views around it.
    """
    batch = dataset.batch(indices)
    with method.in_use():
        shapes = method.decode(method.encode(batch.images)).surfaces()
    inputs = natural_colors(batch.images.numpy(), inverted=dataset.inverted)
    rows = []
    for i, (vertices, faces, *_) in enumerate(shapes):
        pose = view_poses(torch.zeros(1)) if batch.poses is None else batch.poses[torch.tensor([i])]
        rendering = torch.zeros(MASK_SIZE, MASK_SIZE)
        if len(faces):
            rendering = nmr.render_silhouette(vertices[None], faces, pose.cameras(), image_size=MASK_SIZE)[0]
        greys = (torch.stack([batch.masks[i], rendering]).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        views = draw_surface(shapes[i], orbit(pose, TURNS_DEG), image_size=TILE)
        rows.append([inputs[i], *np.repeat(greys[..., None], 3, axis=-1), *views])
    return tile(rows, ["input", "target", "rendering", "same view", *AROUND])
