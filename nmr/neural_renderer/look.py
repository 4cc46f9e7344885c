"""From world space to the axes of a camera that looks in a direction."""

from __future__ import annotations

from torch import Tensor

from nmr._validate import as_numbers
from nmr.cameras import Orthographic
from nmr.neural_renderer._convert import Numbers, check_batch


def orthographic_look(eye: Numbers, direction: Numbers, up: Numbers) -> Orthographic:
    """The camera at ``eye`` that looks along ``direction``, without perspective."""
    eye, direction = (
        as_numbers(x, name, "[3] or [B, 3]").double()
        for x, name in ((eye, "eye"), (direction, "direction"))
    )
    return Orthographic(eye, eye + direction, up)


def look(
    vertices: Tensor, eye: Numbers, direction: Numbers = (0, 1, 0), up: Numbers | None = None
) -> Tensor:
    """Vertices in the axes of a camera at ``eye`` that looks along ``direction``: x right, y up,
    z forward.

    As :func:`look_at`, with ``z = n(direction)``. ``up`` is (0, 1, 0) unless given. The default
    direction is the published one; it equals ``up`` and gives x = y = 0, so pass another
    direction.

    >>> nr.perspective(nr.look(vertices, [0, 0, -3], [0, 0, 1]))
    """
    return orthographic_look(eye, direction, (0, 1, 0) if up is None else up).transform(
        check_batch(vertices)
    )
