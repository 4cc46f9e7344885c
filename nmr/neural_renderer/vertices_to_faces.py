"""Corners of faces."""

from __future__ import annotations

import torch
from torch import Tensor

from nmr._validate import check_indices
from nmr.neural_renderer._convert import check_batch, integer_faces


def vertices_to_faces(vertices: Tensor, faces: Tensor) -> Tensor:
    """Corners ``[B, F, 3, 3]``: ``corners[b, f, k] = vertices[b, faces[b, f, k]]``.

    ``vertices [B, V, 3]``; ``faces [B, F, 3]`` (or ``[1, F, 3]``, ``[F, 3]`` for all meshes),
    whole numbers of any type. Differentiable in ``vertices``. :class:`Renderer` uses it for light
    only: the kernels read vertices and faces.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and for faces that refer to missing vertices.

    >>> nr.rasterize_silhouettes(nr.vertices_to_faces(vertices, faces), image_size=64)
    """
    vertices = check_batch(vertices)
    faces = integer_faces(faces, vertices)
    check_indices(faces, vertices.shape[1])
    batch = faces.shape[0] if faces.ndim == 3 else vertices.shape[0]
    first = vertices.shape[1] * torch.arange(batch, device=faces.device)
    # embedding, not indexing: its backward pass sums in a fixed order.
    return torch.nn.functional.embedding(
        faces + first[:, None, None], vertices.expand(batch, -1, -1).flatten(0, 1)
    )
