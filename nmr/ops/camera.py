"""Operators: cameras as rows of numbers, and vertices from world space to renderer space.

A camera is a row of 22 numbers: ``[A | t]`` (3 x 4), K (2 x 3), the origin (3) and the extent.
"""

import torch
from torch import Tensor

from ._kernel import kernel


@kernel("camera", gradients="eye at up view", used_by="a camera's transform")
def look_at(
    eye: Tensor,
    at: Tensor,
    up: Tensor,
    view: Tensor,
    along: bool,
    right_handed: bool,
    perspective: bool,
    double: bool,
) -> Tensor:
    """Cameras ``[B or 1, 22]``, float64 or float32, at ``eye``, float64 ``[3]`` or ``[B, 3]`` as
    ``at`` and ``up``.

    They look at the point ``at`` or, with ``along``, in that direction. view ``[]`` or ``[B]`` is
    half of the field of view in degrees or, without perspective, the scale.
    """
    sizes = [x.shape[0] for x, axes in ((eye, 2), (at, 2), (up, 2), (view, 1)) if x.ndim == axes]
    batch = next((size for size in sizes if size != 1), 1)
    return eye.new_empty((batch, 22), dtype=torch.float64 if double else torch.float32)


@kernel("points", gradients="vertices camera distortion", used_by="a camera's transform")
def project(
    vertices: Tensor,
    camera: Tensor,
    distortion: Tensor | None,
    starts: Tensor | None,
    perspective: bool,
) -> Tensor:
    """Vertices ``[B or 1, V, 3]`` or packed ``[N, 3]`` in renderer space, ``[B, V, 3]`` or
    ``[N, 3]``.

    For a camera ``[B or 1, 22]``: ``u = A (v - origin) + t``; ``p = (u_x, u_y)``, if perspective
    divided by u_z and distorted by ``distortion`` ``[B or 1, 4, 5 or 8]`` or None; x and y are K
    times ``(p_x, p_y) / extent`` and 1, z is u_z.
    """
    if starts is not None:
        return vertices.new_empty(vertices.shape)
    sizes = [
        x.shape[0] for x in (vertices, camera, distortion) if x is not None and x.shape[0] != 1
    ]
    return vertices.new_empty((sizes[0] if sizes else 1, *vertices.shape[1:]))
