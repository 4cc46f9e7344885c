"""Occupancy grids of meshes."""

from __future__ import annotations

import torch
from torch import Tensor

from . import ops
from ._validate import check_choice, check_faces, check_size, check_vertices


@torch.no_grad()
def voxelize(
    vertices: Tensor,
    faces: Tensor,
    size: int = 32,
    normalize: bool = False,
    definition: str = "kato18",
) -> Tensor:
    """Filled occupancy grids, in one of the two definitions behind the published voxel IoU
    figures.

    A cell is occupied if it belongs to the surface, or cannot be reached from the border of the
    grid through 6-connected cells that do not. A shape that reaches beyond the grid is open there,
    and stays empty. Cells of the surface are:

    - "kato18" (Kato et al. 2018): cells that contain a vertex, and cells with an edge that meets a
      face (tested by rays along the three axes through integer coordinates);
    - "kato19" (Kato and Harada 2019): every cell that a face touches, both at a plane between
      two: a separating axis test of triangle and cube, with cells enlarged by 1e-9 on each side.

    Within the grid kato19 contains kato18, but for float32 rounding of the rays, and differs in few
    cells. Of faces in the planes between cells kato18 marks only the cells on the upper side: it
    leaves out a face at coordinate 1.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
        In [0, 1]^3, which the grid spans. Computed in float32; the separating axes of kato19 in
        float64, of the float32 coordinates times s.
    faces : integer Tensor [F, 3], or [B, F, 3]
    size : int
        s, cells per side.
    normalize : bool
        First fit the batch into the grid: subtract the least coordinate per axis, divide by the
        largest extent times s / (s - 1), and centre each axis; all of the whole batch, as
        published.
    definition : "kato18" or "kato19"
        In kato19 a face touches nothing if a corner is not finite or farther than 2^20 cells from 0
        on an axis (published: a NaN fills the grid).

    Returns
    -------
    bool Tensor [B, s, s, s]
        ``voxels[b, i, j, k]`` is the cell ``[i, i+1) x [j, j+1) x [k, k+1)`` of x, y, z times s.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and sizes, missing vertices of faces, and an unknown definition.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> nmr.voxelize(0.4 * vertices + 0.5, faces).float().mean()  # close to 4/3 pi 0.4^3
    >>> nmr.voxelize(0.4 * vertices + 0.5, faces, definition="kato19").float().mean()  # at least as much
    """
    check_size(size, "size", 512)
    check_choice(definition, "definition", ("kato18", "kato19"))
    vertices = check_vertices(vertices)
    faces = check_faces(faces, vertices.shape[0], vertices.device)
    vertices = vertices.detach().float()
    if normalize and vertices.numel():
        vertices = vertices - vertices.amin(dim=(0, 1))
        vertices = vertices / vertices.max()
        vertices = vertices * ((size - 1) / size)
        vertices = vertices + (1 - vertices.amax(dim=(0, 1))) / 2
    return ops.voxels(vertices, faces, size, definition == "kato19")
