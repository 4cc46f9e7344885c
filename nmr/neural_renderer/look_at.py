"""From world space to the axes of a camera that looks at a point."""

from __future__ import annotations

from torch import Tensor

from nmr.cameras import Orthographic
from nmr.neural_renderer._convert import Numbers, check_batch


def look_at(
    vertices: Tensor, eye: Numbers, at: Numbers = (0, 0, 0), up: Numbers = (0, 1, 0)
) -> Tensor:
    """Vertices in the axes of a camera at ``eye`` that looks at ``at``: x right, y up, z forward.

    ``out = R (v - eye)`` with rows of R ``x = n(up x z), y = n(z x x), z = n(at - eye)`` and
    ``n(v) = v / max(|v|, 1e-5)``. ``vertices [B, V, 3]``; eye, at and up are ``[3]`` or
    ``[B, 3]``: lists, tuples, arrays or tensors. One mesh and B cameras give B meshes.
    Differentiable in everything that is a tensor. An eye above or below ``at`` gives x = y = 0,
    as published; give another ``up`` then. :class:`nmr.LookAt` is this with :func:`perspective`.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes.

    >>> nr.perspective(nr.look_at(vertices, [0, 0, -3]))
    """
    return Orthographic(eye, at, up).transform(check_batch(vertices))
