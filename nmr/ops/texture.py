"""Operators: texture images at uv coordinates, their mipmaps, and the level of each pixel.

Texels of several images, or of all levels of their mipmaps, are concatenated: ``[N, C]``.
``grids`` is int64 ``[I, L, 3]`` in host memory: first texel, height and width of each level of
each image; I is 1 or B.
"""

from torch import Tensor

from ._kernel import kernel

WRAPS = ("repeat", "clamp", "mirror")  # in the order of the kernel's numbers


@kernel("pyramid", gradients="texels", used_by="render_rgb")
def mipmaps(texels: Tensor, grids: Tensor, count: int) -> Tensor:
    """All levels ``[count, C]`` of concatenated images ``[., C]``; each texel is the mean of
    those that it covers.
    """
    return texels.new_empty((count, texels.shape[1]))


@kernel("level")
def uv_levels(
    vertices: Tensor,
    faces: Tensor,
    mesh_starts: Tensor | None,
    uv: Tensor,
    corners: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    grids: Tensor,
) -> Tensor:
    """The mipmap level of each pixel ``[B, H, W]``, OpenGL's; 0 on background. Give it detached
    tensors.
    """
    return weights.new_empty(face_index.shape)


@kernel("colors", gradients="texels uv weights", used_by="render_rgb")
def sample_uv(
    texels: Tensor,
    grids: Tensor,
    level: Tensor | None,
    uv: Tensor,
    corners: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    wrap: int,
) -> Tensor:
    """Colours ``[B, H, W, C]`` of texture images at the uv of each pixel; 0 on background.

    uv, corners, face_index, weights and starts are those of :func:`nmr.ops.interpolate`. Bilinear
    on level 0, or linear between the two levels around ``level [B, H, W]``, a constant. wrap is
    an index of ``WRAPS``. Differentiable in texels, uv and weights.
    """
    return texels.new_empty((*face_index.shape, texels.shape[-1]))
