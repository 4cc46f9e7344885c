"""Operators: meshes in clip space. Barycentric weights with their derivatives on the screen, and
silhouette edges.

``positions [B or 1, V, 4]`` are (x, y, z, w), ``faces [F, 3]`` int64, face index maps int32
``[B, H, W]``. Row 0 of all images is the bottom.
"""

from torch import Tensor

from ._kernel import kernel


@kernel("rast slopes", gradients="positions", used_by="rasterize")
def clip_weights(positions: Tensor, faces: Tensor, face_index: Tensor) -> tuple[Tensor, Tensor]:
    """``[B, H, W, 4]`` (b_0, b_1, z / w, face + 1), and (db_0/dX, db_0/dY, db_1/dX, db_1/dY) in
    pixels.

    0 on background. z / w has no gradient.
    """
    shape = (*face_index.shape, 4)
    return positions.new_empty(shape), positions.new_empty(shape)


@kernel("blended", gradients="colors positions", used_by="antialias")
def antialias(
    colors: Tensor,
    rast: Tensor,
    positions: Tensor,
    faces: Tensor,
    face_index: Tensor,
    twins: Tensor,
) -> Tensor:
    """Colours ``[B, H, W, C]`` blended between neighbours that a silhouette edge separates.

    ``rast`` is that of :func:`clip_weights`. ``twins [F, 3]`` int64: the edge opposite to corner
    k of face f is numbered 3 f + k; its entry is the next edge with the same two vertices,
    cyclically, or itself. Differentiable in colors and positions.
    """
    return colors.new_empty(colors.shape)
