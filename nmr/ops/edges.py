"""Operator: from raster pixels to image pixels, with a gradient of the edges."""

from torch import Tensor

from ._kernel import kernel


@kernel("resolved", gradients="image background vertices", used_by="render")
def resolve(
    image: Tensor,
    background: Tensor | None,
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    anti_aliasing: bool,
    eps: float,
    local: bool,
    perspective: bool,
) -> Tensor:
    """The image ``[B, h, w, C]`` of raster pixels ``[B, H, W, C]``: the mean of 2x2 with
    anti-aliasing, else a copy.

    Pixels without a face have the colour ``background [B or 1, C]``; without it that in
    ``image``. The gradients in ``image`` and ``background`` are those of the mean. That in x and
    y of ``vertices`` is that of the edges, summed over channels: NMR's, or the local one, which
    needs to know whether the camera has ``perspective``. NMR's: if an upstream gradient of an
    image is not finite, those of all its visible faces are NaN.
    """
    scale, (batch, height, width, channels) = 2 if anti_aliasing else 1, image.shape
    return image.new_empty((batch, height // scale, width // scale, channels))
