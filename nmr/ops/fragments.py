"""Operators: barycentric weights and depth of the nearest face at each pixel, and depth images."""

from torch import Tensor

from ._kernel import kernel


@kernel("weights depth", gradients="vertices", used_by="render_fragments")
def fragments(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    far: float,
    perspective: bool,
) -> tuple[Tensor, Tensor]:
    """Weights ``[B, H, W, 3]``, in space, of the nearest face's own vertices 0, 1, 2, and depth
    ``[B, H, W]``.

    With ``perspective`` 1 / depth is linear on the screen, else depth itself. On the background
    the weights are 0 and the depth is ``far``. Both are differentiable in the vertices at fixed
    face indices.
    """
    return vertices.new_empty((*face_index.shape, 3)), vertices.new_empty(face_index.shape)


@kernel("depth", gradients="vertices", used_by="render_depth")
def depth_image(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    anti_aliasing: bool,
    far: float,
    perspective: bool,
) -> Tensor:
    """Depth ``[B, h, w]`` of a face index map; with anti-aliasing the mean of 2x2 pixels, ``far``
    mixed in.

    The same numbers as the depth of :func:`fragments`, with a true derivative at fixed face
    indices, but faster.
    """
    scale, (batch, height, width) = 2 if anti_aliasing else 1, face_index.shape
    return vertices.new_empty((batch, height // scale, width // scale))
