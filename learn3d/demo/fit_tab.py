"""A sphere that is fitted to silhouettes by gradient descent through the renderer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import nmr
from learn3d.data.conventions import mesh_to_object
from learn3d.make_data.shapes import make_shape
from learn3d.pictures.sheets import stack, tile
from learn3d.pictures.surfaces import Surface, draw_around

#: Where the eye of each orthographic camera stands, and what is up there; object frame, 1 is the picture's border.
SIDES = {"front": ((0, 0, -5), (0, 1, 0)), "side": ((5, 0, 0), (0, 1, 0)), "top": ((0, 5, 0), (0, 0, 1))}
SIZE = 96  # pixels
STEPS = 160
_EVERY = 8  # steps, between two pictures
_SMOOTHNESS = 1e-4
_TARGET, _FITTED, _BOTH = (240, 170, 60), (70, 120, 200), (150, 150, 150)


class Moment(NamedTuple):
    """Where the fit stands."""

    step: int
    iou: float  # mean over the sides
    surface: Surface
    picture: np.ndarray  # uint8 [H, W, 3]: silhouettes of both from each side, and the mesh


def silhouettes(vertices: Tensor, faces: Tensor, sides: list[str]) -> Tensor:
    """Silhouettes float32 [N,SIZE,SIZE] of a mesh of the object frame from these `SIDES`, differentiable."""
    eyes, ups = (torch.tensor([SIDES[side][k] for side in sides], dtype=torch.float64) for k in (0, 1))
    return nmr.render_silhouette(vertices, faces, nmr.Orthographic(eyes, up=ups), image_size=SIZE)


def example_silhouettes(category: str, seed: int) -> dict[str, np.ndarray]:
    """Masks uint8 [SIZE,SIZE] of a generated object from all `SIDES`."""
    mesh = make_shape(category, np.random.default_rng(seed))
    vertices = torch.from_numpy(np.asarray(1.6 * mesh.vertices @ mesh_to_object("y", "z").T, np.float32))
    images = silhouettes(vertices, torch.tensor(mesh.faces), list(SIDES))
    return dict(zip(SIDES, (images * 255).byte().numpy(), strict=True))


def fit(masks: Mapping[str, np.ndarray], steps: int = STEPS) -> Iterator[Moment]:
    """Fit a sphere to masks uint8 [H,W] (255: object), named by `SIDES`; empty ones are left out.

    Minimises soft IoU loss + smoothness. The variable is (1 + 3 L) vertices with the Laplacian L: what pulls at one
    vertex then moves its region (Nicolet et al. 2021). Raises ValueError where fewer than two sides are drawn.
    """
    masks = {side: mask for side, mask in masks.items() if mask is not None and (mask > 127).any()}
    if len(masks) < 2:
        raise ValueError("draw the object from two sides at least")
    names, target = list(masks), torch.stack([_small(mask) for mask in masks.values()])
    sphere, faces = nmr.icosphere(3)
    edges = nmr.edge_table(faces)
    neighbours = torch.zeros(len(sphere), len(sphere))
    neighbours[edges[:, :2], edges[:, :2].flip(1)] = 1
    stiffness = torch.eye(len(sphere)) + 3 * (torch.diag(neighbours.sum(1)) - neighbours)
    softness = torch.linalg.inv(stiffness)
    shape = (stiffness @ (0.4 * sphere)).requires_grad_()
    optimizer = torch.optim.Adam([shape], lr=0.03)
    for step in range(steps + 1):
        vertices = softness @ shape
        images = silhouettes(vertices, faces, names)
        loss = nmr.losses.soft_iou_loss(images, target)
        if step % _EVERY == 0 or step == steps:
            surface = Surface(vertices.detach(), faces)
            yield Moment(step, 1 - loss.item(), surface, _picture(surface, names, images.detach(), target, step))
        optimizer.zero_grad()
        (loss + _SMOOTHNESS * nmr.losses.smoothness_loss(vertices, edges)).backward()
        optimizer.step()


def _small(mask: np.ndarray) -> Tensor:
    """A mask as float32 [SIZE,SIZE]."""
    image = Image.fromarray(mask).resize((SIZE, SIZE), Image.Resampling.BOX)
    return torch.from_numpy(np.asarray(image, np.float32) / 255)


def _picture(surface: Surface, names: list[str], images: Tensor, target: Tensor, step: int) -> np.ndarray:
    palette = np.array([(255, 255, 255), _TARGET, _FITTED, _BOTH], np.uint8)
    overlays = palette[((target > 0.5) + 2 * (images > 0.5)).int().numpy()]
    (view,) = draw_around(surface, [-30.0 - 2.0 * step], image_size=2 * SIZE)
    tiles = [
        tile([[picture]], [title], tile_size=2 * SIZE)
        for picture, title in zip([*overlays, view], [*names, "mesh"], strict=True)
    ]
    rows = [np.concatenate(tiles[k : k + 2], axis=1) for k in range(0, len(tiles), 2)]
    return stack(rows)
