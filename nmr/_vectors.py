"""Rows of points and vectors ``[..., 3]``."""

import torch
from torch import Tensor


def unit(vectors: Tensor) -> Tensor:
    """Vectors over their lengths; 0, with gradient 0, if the length is 0."""
    # Scaled to a largest coordinate of 1 first, so that the squares neither under- nor overflow.
    # The result does not depend on the scale, so neither does its derivative.
    scale = vectors.detach().abs().amax(-1, keepdim=True)
    zero = scale < torch.finfo(vectors.dtype).tiny
    vectors = torch.where(zero, 1.0, vectors / torch.where(zero, 1.0, scale))
    return torch.where(zero, 0.0, vectors / vectors.square().sum(-1, keepdim=True).sqrt())


def face_cross(corners: Tensor) -> Tensor:
    """Normals of counter-clockwise faces ``[..., 3, 3]``, each with twice the area of its face as
    its length.
    """
    p0, p1, p2 = corners.unbind(-2)
    return torch.linalg.cross(p1 - p0, p2 - p0)


def gather_rows(rows: Tensor, indices: Tensor) -> Tensor:
    """Rows ``[B, N, 3]`` of ``[B, V, 3]`` at indices ``[N]`` or ``[B, N]``. On a CPU,
    torch.gather is the fastest way, forward and backward.
    """
    each = indices.expand(rows.shape[0], -1).unsqueeze(-1).expand(-1, -1, 3)
    return torch.gather(rows, 1, each)
