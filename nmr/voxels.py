"""Occupancy grids of meshes."""

from __future__ import annotations

import torch
from torch import Tensor

from . import ops
from ._validate import check_faces, check_size, check_vertices


@torch.no_grad()
def voxelize(vertices: Tensor, faces: Tensor, size: int = 32, normalize: bool = False) -> Tensor:
    """Filled occupancy grids, in the definition behind the published voxel IoU figures ("kato18").

    A cell is on the surface if a ray along an axis through one of its four corner lines (integer coordinates) meets a
    face in it, or if it holds a vertex; it is occupied if it cannot be reached from the border of the grid through
    6-connected cells that are not on the surface. A shape that leaves the grid is open, hence hollow.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
        In [0, 1]^3, which the grid spans. Computed in float32.
    faces : integer Tensor [F, 3], or [B, F, 3]
    size : int
        s, cells per side.
    normalize : bool
        First fit the batch into the grid: subtract the least coordinate per axis, divide by the largest extent times
        s / (s - 1), and centre each axis. Minimum and extent are those of the whole batch, as published.

    Returns
    -------
    bool Tensor [B, s, s, s]
        ``voxels[b, i, j, k]`` is the cell ``[i, i+1) x [j, j+1) x [k, k+1)`` of x, y, z times s.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and sizes, and for faces that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> nmr.voxelize(0.4 * vertices + 0.5, faces).float().mean()  # close to 4/3 pi 0.4^3
    """
    check_size(size, "size", 512)
    vertices = check_vertices(vertices)
    faces = check_faces(faces, vertices.shape[0], vertices.device)
    vertices = vertices.detach().float()
    if normalize and vertices.numel():
        vertices = vertices - vertices.amin(dim=(0, 1))
        vertices = vertices / vertices.max()
        vertices = vertices * ((size - 1) / size)
        vertices = vertices + (1 - vertices.amax(dim=(0, 1))) / 2
    return ops.voxels(vertices, faces, size)
