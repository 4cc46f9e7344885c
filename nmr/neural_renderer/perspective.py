"""Perspective division."""

from __future__ import annotations

from torch import Tensor

from nmr.cameras import LookAt
from nmr.neural_renderer._convert import check_batch


def perspective(vertices: Tensor, angle: float | Tensor = 30.0) -> Tensor:
    """``(x / (z tan a), y / (z tan a), z)`` of vertices ``[B, V, 3]`` in camera axes.

    ``angle`` is *half* the field of view in degrees, between 0 and 90: a number, or a tensor
    ``[]`` or ``[B]``. Differentiable in both. A vertex in the plane of the eye gets x = y = inf,
    so that its faces are not drawn.

    Raises
    ------
    TypeError, ValueError
        For wrong types, shapes and angles.

    >>> nr.perspective(nr.look_at(vertices, [0, 0, -3]), angle=15)
    """
    return LookAt((0, 0, 0), (0, 0, 1), half_fov_deg=angle).transform(check_batch(vertices))
