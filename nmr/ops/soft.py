"""Operators: the soft silhouette of SoftRas, and the faces around each pixel."""

import torch
from torch import Tensor

from ._kernel import kernel
from .raster import batch_size


@kernel(
    "transmittance",
    gradients="vertices sigma",
    keep="transmittance",
    used_by="render_soft_silhouette",
)
def soft_silhouette(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    sigma: Tensor,
    height: int,
    width: int,
    fill_back: bool,
    near: float,
    far: float,
    reach_per_sigma: float,
) -> Tensor:
    """``1 - alpha`` at each raster pixel, ``[B, height, width]``: the product of 1 - D over all
    faces.

    sigma is float64 ``[]``. The gradient in vertices is zero in z.
    """
    return vertices.new_empty((batch_size(vertices, starts), height, width))


@kernel("face_index")
def soft_layers(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    sigma: Tensor,
    height: int,
    width: int,
    layers: int,
    fill_back: bool,
    near: float,
    far: float,
    perspective: bool,
    reach_per_sigma: float,
) -> Tensor:
    """Face indices ``[B, height, width, layers]`` of the nearest faces within reach, nearest
    first, then -1.

    Each face counts once: f if it is seen from its front, else F + f. sigma is float64 ``[]``.
    """
    return vertices.new_empty(
        (batch_size(vertices, starts), height, width, layers), dtype=torch.int32
    )


@kernel("weights depth distances", gradients="vertices", used_by="render_soft")
def soft_fragments(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    far: float,
    perspective: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Weights ``[B, H, W, K, 3]``, depth and distances ``[B, H, W, K]`` of a table of faces
    ``[B, H, W, K]``.

    Distances are those of pixels outside to the border of the face, squared, and minus those of
    pixels inside. A pixel outside has the weights on the screen that are clamped to [0, 1] and
    divided by their sum. All are differentiable.
    """
    sizes = (*face_index.shape, 3), face_index.shape, face_index.shape
    return tuple(vertices.new_empty(size) for size in sizes)
