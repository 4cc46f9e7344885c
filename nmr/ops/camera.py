"""Operator: vertices from world space to renderer space."""

from torch import Tensor

from ._kernel import kernel

# of each parameter of cameras from eye to distortion, if there is one for each camera
_AXES = 2, 2, 2, 1, 3, 3, 2, 1, 2


def count_cameras(*parameters: Tensor | None) -> int:
    """B of the parameters of :func:`project` from ``eye`` on: one for all cameras, or one each."""
    for parameter, axes in zip(parameters, _AXES, strict=False):
        if parameter is not None and parameter.ndim == axes and parameter.shape[0] != 1:
            return parameter.shape[0]
    return 1


def allocate_points(
    vertices: Tensor, starts: Tensor | None, *parameters: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Points and cameras of :func:`project`, given its parameters from ``eye`` to ``distortion``."""
    *posed, distortion = parameters
    cameras = count_cameras(*posed)
    sizes = vertices.shape[0], cameras, 1 if distortion is None else distortion.shape[0]
    batch = next((size for size in sizes if size != 1), 1)
    shape = vertices.shape if starts is not None else (batch, *vertices.shape[1:])
    return vertices.new_empty(shape), vertices.new_empty((cameras, 22))


@kernel(
    "points camera nearest",
    gradients="vertices eye at up view matrix intrinsics origin extent distortion",
    keep="camera",
    constant="nearest",
    used_by="a camera's transform",
)
def project(
    vertices: Tensor,
    starts: Tensor | None,
    eye: Tensor | None,
    at: Tensor | None,
    up: Tensor | None,
    view: Tensor | None,
    matrix: Tensor | None,
    intrinsics: Tensor | None,
    origin: Tensor | None,
    extent: Tensor | None,
    distortion: Tensor | None,
    along: bool,
    right_handed: bool,
    perspective: bool,
    across: float,
    down: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices ``[B or 1, V, 3]`` or packed ``[N, 3]`` in renderer space, ``[B, V, 3]`` or
    ``[N, 3]``, the cameras, and the least depth of all points ``[]``.

    A camera is a pose, float64 in host memory: ``eye``, ``at`` and ``up`` ``[3]`` or ``[n, 3]``,
    and ``view`` ``[]`` or ``[n]``, half of the field of view in degrees or, without perspective,
    the scale. It looks at the point ``at`` or, with ``along``, in that direction. Or it has parts
    in the dtype of the vertices: ``matrix [n, 3, 4]``, ``intrinsics [n, 2, 3]``, ``origin [n, 3]``
    and ``extent [n]``. n is 1 or B. Then ``u = A (v - origin) + t``; ``p = (u_x, u_y)``, if
    perspective divided by u_z and distorted by ``distortion`` ``[B or 1, 4, 5 or 8]``; x and y
    are K times ``(p_x, p_y) / extent`` and 1, multiplied by ``across`` and ``down``; z is u_z.

    The second result are the parts of the cameras, as rows ``[n, 22]`` of ``[A | t]``, K (both
    rows multiplied), origin and extent.
    """
    parameters = eye, at, up, view, matrix, intrinsics, origin, extent, distortion
    return *allocate_points(vertices, starts, *parameters), vertices.new_empty(())
