"""From occupancy grids to triangle meshes."""

from __future__ import annotations

import torch
from torch import Tensor


def grid_surface(grid: Tensor, *, level: float = 0.5, box: float = 1.0) -> tuple[Tensor, Tensor]:
    """Marching cubes: the surface of a grid [s, s, s] with axes (x, y, z) over the cube [-box/2, box/2].

    Returns vertices float32 [V, 3] in the object frame and faces int64 [F, 3]; both empty where no cell, or every cell,
    is above `level`. Cells at the border are closed. The faces are wound as `nmr.icosphere`'s (normals outwards by the
    right-hand rule in these axes).
    """
    import numpy as np
    from skimage.measure import marching_cubes

    size = grid.shape[-1]
    padded = np.pad(grid.detach().cpu().float().numpy(), 1)
    if not padded.max() > level:
        return torch.empty(0, 3), torch.empty(0, 3, dtype=torch.int64)
    vertices, faces, _, _ = marching_cubes(padded, level, gradient_direction="ascent")
    centred = (vertices - 0.5) / size - 0.5  # cell i of the padded grid has its centre at (i - 1 + 1/2) / size
    return torch.from_numpy((centred * box).astype(np.float32)), torch.from_numpy(faces.astype(np.int64))
