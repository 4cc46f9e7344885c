"""Cube maps: from directions to places on the six faces, and faces with borders from their
neighbours.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

# OpenGL's table: the directions of columns and rows of each face.
_COLUMNS = [[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]]
_ROWS = [[0, -1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0], [0, -1, 0]]


class Places(NamedTuple):
    """Places in images, or on the faces of a cube map."""

    face: Tensor | None  # [B, H, W]; None: no cube map
    at: Tensor  # [B, H, W, 2] in [0, 1] across the face
    derivatives: Tensor | None  # [B, H, W, 4]
    valid: Tensor | None  # [B, H, W]


def places(directions: Tensor, derivatives: Tensor | None) -> Places:
    """The places that directions ``[B, H, W, 3]`` with derivatives ``[B, H, W, 6]`` point to."""
    largest = directions.detach().abs().max(-1).values
    valid = (largest > 0) & directions.isfinite().all(-1)
    directions = torch.where(
        valid.unsqueeze(-1), directions, directions.new_tensor([1.0, 0.0, 0.0])
    )
    axis = directions.detach().abs().argmax(-1)
    along = directions.gather(-1, axis.unsqueeze(-1))
    face = 2 * axis + (along[..., 0] < 0)
    frame = directions.new_tensor([_COLUMNS, _ROWS])[:, face]  # [2, B, H, W, 3]
    at = (frame * directions).sum(-1).movedim(0, -1) / along.abs()
    slopes = None
    if derivatives is not None:
        derivatives = torch.where(valid.unsqueeze(-1), derivatives, 0).unflatten(-1, (3, 2))
        # [B, H, W, (column, row), (X, Y)]
        onto = (frame.unsqueeze(-1) * derivatives).sum(-2).movedim(0, -2)
        forward = derivatives.gather(
            -2, axis[..., None, None].expand(*axis.shape, 1, 2)
        ) * along.sign().unsqueeze(-1)
        slopes = ((onto - at.unsqueeze(-1) * forward) / along.abs().unsqueeze(-1) / 2).flatten(-2)
    return Places(face, (at + 1) / 2, slopes, valid)


def with_borders(image: Tensor) -> Tensor:
    """Faces ``[B, 6, n, n, C]`` one below the other, each with a border from its neighbours:
    ``[B, 6 (n+2), n+2, C]``.

    A corner of the border is the mean of the three texels that meet at the cube's corner.
    """
    batch, _, size, _, channels = image.shape
    texels, corners = (torch.from_numpy(x).to(image.device) for x in _neighbours(size))
    flat = image.reshape(batch, -1, channels)
    flat = torch.cat([flat, flat[:, corners].mean(2)], dim=1)
    return flat[:, texels].view(batch, 6 * (size + 2), size + 2, channels)


@lru_cache(maxsize=32)
def _neighbours(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels at the places of faces with borders ``[6 (n+2) (n+2)]``, and those that meet at
    corners ``[24, 3]``.

    Arrays, because a tensor would belong to the mode of the first call, such as inference mode.
    """
    centres = (2 * np.arange(-1, size + 1) + 1 - size) / size
    row, column = (x[..., None] for x in np.meshgrid(centres, centres, indexing="ij"))
    columns, rows = (np.array(x)[:, None, None] for x in (_COLUMNS, _ROWS))
    outward = np.repeat(np.eye(3), 2, axis=0) * np.array([1.0, -1.0] * 3)[:, None]
    grid = column * columns + row * rows + outward[:, None, None]
    place = places(torch.from_numpy(grid), None)
    at = (place.at.numpy() * size).astype(np.int64).clip(0, size - 1)
    texels = place.face.numpy() * size * size + at[..., 1] * size + at[..., 0]
    sides, corners = ((0, 1), (size + 1, size)), []  # the border, and the row next to it
    for face in texels:
        for y, near_y in sides:
            for x, near_x in sides:
                corners.append([face[near_y, near_x], face[y, near_x], face[near_y, x]])
                face[y, x] = 6 * size * size + len(corners) - 1
    return texels.flatten(), np.array(corners)
