"""Finer meshes of coarse ones, with rounded edges: flat parts stay flat."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from scipy.sparse import coo_array, diags_array
from torch import Tensor

ROUNDS = 4
_SHRINK, _GROW = 0.5, -0.53  # of Taubin 1995: smoothing without loss of volume


def smooth(vertices: Tensor, faces: Tensor, levels: int = 2) -> tuple[Tensor, Tensor]:
    """Vertices float32 [W, 3] and faces int64 [4^levels F, 3] of a finer mesh of [V, 3], [F, 3].

    Every face is cut into 4^levels flat ones; then edges are rounded by Taubin's smoothing, over about the width of one
    of these.
    """
    points, triangles = vertices.double().numpy(), faces.numpy()
    for _ in range(levels):
        points, triangles = trimesh.remesh.subdivide(points, triangles)
    neighbours = joined(triangles, len(points))
    mean = diags_array(1 / np.maximum(neighbours.sum(1), 1)) @ neighbours
    for _ in range(ROUNDS):
        for share in (_SHRINK, _GROW):
            points = points + share * (mean @ points - points)
    return torch.from_numpy(points.astype(np.float32)), torch.from_numpy(np.asarray(triangles, np.int64))


def joined(faces: np.ndarray, count: int) -> coo_array:
    """Which of `count` vertices share an edge of faces [F, 3]: a sparse matrix of zeros and ones, CSR."""
    rows, columns = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    edges = coo_array((np.ones(len(rows)), (rows, columns)), (count, count)).tocsr()
    return ((edges + edges.T) > 0).astype(np.float64)
