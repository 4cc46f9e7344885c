"""Operators on meshes alone: the smoothness loss, and occupancy grids."""

import torch
from torch import Tensor

from ._kernel import kernel


@kernel("loss", gradients="vertices", used_by="smoothness_loss")
def smoothness(vertices: Tensor, edges: Tensor) -> Tensor:
    """Smoothness loss of each mesh, ``[B]``."""
    return vertices.new_empty(vertices.shape[0])


@kernel("grid")
def voxels(vertices: Tensor, faces: Tensor, size: int, touched: bool) -> Tensor:
    """Filled occupancy grids ``[B, s, s, s]`` (bool) of meshes in [0, 1]^3; not differentiable.

    The surface is defined by kato18 or, if ``touched``, by kato19 (every cell that a face
    touches).
    """
    return vertices.new_empty((vertices.shape[0], size, size, size), dtype=torch.bool)
