"""Predicted shapes, meshes or occupancy grids, and the surface of a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from skimage.measure import marching_cubes
from torch import Tensor

from learn3d.pictures.surfaces import Surface


@dataclass(frozen=True, eq=False)
class Meshes:
    """Predicted surfaces, on the CPU."""

    vertices: Tensor  # float32 [B, V, 3], object frame
    faces: Tensor  # int64 [F, 3]

    def surfaces(self) -> list[Surface]:
        """The shapes one by one."""
        return [Surface(vertices, self.faces) for vertices in self.vertices]


@dataclass(frozen=True, eq=False)
class Grids:
    """Predicted volumes, on the CPU."""

    occupancy: Tensor  # float32 [B, s, s, s] in [0, 1]; axes (x, y, z) of the object frame over the box [-0.5, 0.5]
    threshold: float = 0.5  # cells above it are occupied

    def surfaces(self) -> list[Surface]:
        """The shapes one by one, by marching cubes at the threshold."""
        return [grid_surface(grid, level=self.threshold) for grid in self.occupancy]

    def occupied(self, size: int) -> Tensor:
        """Bool [B, size, size, size]: whether the mean of a larger cell is above the threshold; s must be a multiple of
        size.
        """
        factor, rest = divmod(self.occupancy.shape[-1], size)
        if rest or factor < 1:
            raise ValueError(f"a grid of {self.occupancy.shape[-1]} cells cannot be pooled to {size}")
        return F.avg_pool3d(self.occupancy[:, None], factor)[:, 0] > self.threshold


def grid_surface(grid: Tensor, *, level: float = 0.5, box: float = 1.0) -> Surface:
    """Marching cubes: the surface of a grid [s, s, s] with axes (x, y, z) over the cube [-box/2, box/2]^3.

    The surface is empty if no cell is above `level`, and closed at the border of the grid. Normals point outwards by
    the right-hand rule in these axes, as `nmr.icosphere`'s do.
    """
    size = grid.shape[-1]
    padded = np.pad(grid.detach().cpu().float().numpy(), 1)
    if not padded.max() > level:
        return Surface(torch.empty(0, 3), torch.empty(0, 3, dtype=torch.int64))
    vertices, faces, _, _ = marching_cubes(padded, level, gradient_direction="ascent")
    centred = (vertices - 0.5) / size - 0.5  # cell i of the padded grid has its centre at (i - 1 + 1/2) / size
    points = torch.from_numpy((centred * box).astype(np.float32))
    return Surface(points, torch.from_numpy(faces.astype(np.int64)))
