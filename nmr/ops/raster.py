"""Operators: faces cut at the near plane, the nearest face at each pixel, silhouettes with their
gradients.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ._kernel import kernel
from .camera import allocate_points


class RasterSettings(NamedTuple):
    """The settings of a render, in the order of the operators' arguments."""

    height: int  # rows of the image
    width: int
    anti_aliasing: bool
    fill_back: bool
    near: float
    far: float
    eps: float
    perspective: bool  # 1 / depth is linear on the screen, else depth itself

    @property
    def raster(self) -> tuple[int, int]:
        scale = 2 if self.anti_aliasing else 1
        return scale * self.height, scale * self.width

    @property
    def visibility(self) -> tuple[bool, float, float]:
        """Which faces are seen: from their backs too, between the limits of the depth."""
        return self.fill_back, self.near, self.far


def batch_size(vertices: Tensor, starts: Tensor | None) -> int:
    """B of vertices ``[B, V, 3]``, or of packed vertices ``[N, 3]`` with starts ``[B + 1, 2]``."""
    return vertices.shape[0] if starts is None else starts.shape[0] - 1


@kernel("counts")
def clip_count(vertices: Tensor, faces: Tensor, starts: Tensor | None, near: float) -> Tensor:
    """Room that the clipped meshes need: int64 ``[B, 2]``, new vertices and drawn faces."""
    return vertices.new_empty((batch_size(vertices, starts), 2), dtype=torch.int64)


@kernel("drawn_faces source corners ends")
def clip_faces(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    near: float,
    new_starts: Tensor,
    num_new: int,
    num_drawn: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The faces to draw, packed: ``faces [M, 3]``, ``source [M]`` (int32), ``corners [M, 3]``,
    ``ends [P, 4]`` (int64).

    Only the topology; no gradients pass through here. ``new_starts [B + 1, 2]`` in host memory
    are first new vertex and first drawn face of each mesh, then P = num_new and M = num_drawn.
    New vertices are numbered after the V of their mesh. ``source`` is the face that a drawn face
    is part of; ``corners`` says which of its corners are those of the source (0, 1, 2) or new
    vertices (3 + number); ``ends`` are the two rows of ``vertices.reshape(-1, 3)`` that a new
    vertex is between, and which corners of the source these are. Room that is left over is filled
    with faces without area.
    """
    shapes = (num_drawn, 3), (num_drawn,), (num_drawn, 3), (num_new, 4)
    types = torch.int64, torch.int32, torch.int64, torch.int64
    return tuple(
        vertices.new_empty(shape, dtype=dtype) for shape, dtype in zip(shapes, types, strict=True)
    )


@kernel("face_index")
def rasterize(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    height: int,
    width: int,
    fill_back: bool,
    near: float,
    far: float,
    perspective: bool,
) -> Tensor:
    """Face index map ``[B, height, width]`` of meshes in renderer space; not differentiable."""
    return vertices.new_empty((batch_size(vertices, starts), height, width), dtype=torch.int32)


@kernel("face_index")
def rasterize_layers(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    height: int,
    width: int,
    layers: int,
    fill_back: bool,
    near: float,
    far: float,
    perspective: bool,
) -> Tensor:
    """Face indices of the nearest surfaces at each pixel, ``[B, height, width, layers]``, nearest
    first, then -1.
    """
    return vertices.new_empty(
        (batch_size(vertices, starts), height, width, layers), dtype=torch.int32
    )


def no_camera(perspective: bool) -> tuple:
    """The arguments of :func:`silhouette` from ``eye`` to ``down`` for vertices in renderer space."""
    return *(None,) * 9, False, False, perspective, 1.0, 1.0


@kernel(
    "alpha face_index points camera cut",
    gradients="vertices eye at up view matrix intrinsics origin extent distortion",
    constant="face_index points camera cut",
    used_by="render_silhouette",
)
def silhouette(
    vertices: Tensor,
    faces: Tensor,
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
    height: int,
    width: int,
    anti_aliasing: bool,
    fill_back: bool,
    near: float,
    far: float,
    eps: float,
    clip: bool,
    local: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Silhouettes ``alpha [B, height, width]`` and the face index map ``[B, H, W]`` of meshes,
    points and cameras of :func:`project`, whose camera comes first, and a bool ``[]``: whether a
    point is nearer than ``near`` with ``clip``. Both images are empty then. Without a camera
    (:func:`no_camera`) these three are not used.

    The gradient is NMR's silhouette gradient or, if ``local``, Kato and Harada's, which reaches
    one pixel. Zero in z of renderer space.
    """
    parameters = eye, at, up, view, matrix, intrinsics, origin, extent, distortion
    if eye is None and matrix is None:
        points, cameras = vertices.new_empty(0), vertices.new_empty(0)
        batch = batch_size(vertices, starts)
    else:
        points, cameras = allocate_points(vertices, starts, *parameters)
        batch = batch_size(points, starts)
    scale = 2 if anti_aliasing else 1
    alpha = vertices.new_empty((batch, height, width))
    raster = (batch, scale * height, scale * width)
    face_index = vertices.new_empty(raster, dtype=torch.int32)
    return alpha, face_index, points, cameras, vertices.new_empty((), dtype=torch.bool)
