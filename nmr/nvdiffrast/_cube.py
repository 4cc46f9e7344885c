"""Cube maps: from directions to places on the six faces, and faces with borders from their
neighbours.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

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
    frame = torch.tensor([_COLUMNS, _ROWS]).to(directions)[:, face]  # [2, B, H, W, 3]
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
    texels, corners = (x.to(image.device) for x in _neighbours(size))
    flat = image.reshape(batch, -1, channels)
    flat = torch.cat([flat, flat[:, corners].mean(2)], dim=1)
    return flat[:, texels].view(batch, 6 * (size + 2), size + 2, channels)


@lru_cache(maxsize=32)
def _neighbours(size: int) -> tuple[Tensor, Tensor]:
    """Texels at the places of faces with borders ``[6 (n+2) (n+2)]``, and those that meet at
    corners ``[24, 3]``.
    """
    centres = (2 * torch.arange(-1, size + 1, dtype=torch.float64) + 1 - size) / size
    row, column = torch.meshgrid(centres, centres, indexing="ij")
    columns, rows = torch.tensor(_COLUMNS).double(), torch.tensor(_ROWS).double()
    outward = (
        torch.eye(3, dtype=torch.float64).repeat_interleave(2, 0)
        * torch.tensor([1.0, -1.0] * 3).double()[:, None]
    )
    grid = (
        column[..., None] * columns[:, None, None]
        + row[..., None] * rows[:, None, None]
        + outward[:, None, None]
    )
    place = places(grid, None)
    at = (place.at * size).floor().long().clamp(0, size - 1)
    texels = place.face * size * size + at[..., 1] * size + at[..., 0]
    inner, corners = [1, size], []
    for face in range(6):
        for y, near_y in ((0, inner[0]), (size + 1, inner[1])):
            for x, near_x in ((0, inner[0]), (size + 1, inner[1])):
                corners.append(
                    torch.stack(
                        [
                            texels[face, near_y, near_x],
                            texels[face, y, near_x],
                            texels[face, near_y, x],
                        ]
                    )
                )
                texels[face, y, x] = 6 * size * size + len(corners) - 1
    return texels.flatten(), torch.stack(corners)
