"""Operators: from raster pixels to image pixels, with NMR's gradient of the edges."""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd


def _image_shape(image, anti_aliasing) -> tuple[int, int, int, int]:
    scale = 2 if anti_aliasing else 1
    return image.shape[0], image.shape[1] // scale, image.shape[2] // scale, image.shape[3]


def _raster_shape(resolved, anti_aliasing) -> tuple[int, int, int, int]:
    scale = 2 if anti_aliasing else 1
    return resolved.shape[0], scale * resolved.shape[1], scale * resolved.shape[2], resolved.shape[3]


# --- resolve


@operator
def resolve(
    image: Tensor,
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    owner: Tensor,
    anti_aliasing: bool,
    eps: float,
) -> Tensor:
    """The image ``[B, h, w, C]`` of raster pixels ``[B, H, W, C]``: the mean of 2x2 with anti-aliasing, else a copy.

    The gradient in ``image`` is that of the mean. That in x and y of ``vertices`` is NMR's, summed over channels.
    """
    resolved = host_empty(_image_shape(image, anti_aliasing), dtype=image.dtype)
    _C.resolve_forward(host_array(image), resolved.numpy(), anti_aliasing, num_threads())
    return resolved.to(image.device)


@torch.library.register_fake(resolve)
def _(image, vertices, faces, starts, owner, anti_aliasing, eps):
    return image.new_empty(_image_shape(image, anti_aliasing))


def _resolve_setup(ctx, inputs, output):
    image, vertices, faces, starts, owner, anti_aliasing, eps = inputs
    ctx.save_for_backward(image, vertices, faces, starts, owner)
    ctx.settings = anti_aliasing, eps


def _resolve_backward(ctx, grad_resolved):
    image, vertices, faces, starts, owner = ctx.saved_tensors
    anti_aliasing, eps = ctx.settings
    grad_image = resolve_backward(grad_resolved, anti_aliasing)
    grad_vertices = None
    if ctx.needs_input_grad[1]:
        grad_vertices = edges_backward(vertices, faces, starts, owner, image, grad_image, eps)
    return grad_image, grad_vertices, None, None, None, None, None


register_autograd(resolve, _resolve_backward, _resolve_setup)


@operator
def resolve_backward(grad_resolved: Tensor, anti_aliasing: bool) -> Tensor:
    """Gradient ``[B, H, W, C]`` of the mean in :func:`resolve`."""
    grad_image = host_empty(_raster_shape(grad_resolved, anti_aliasing), dtype=grad_resolved.dtype)
    _C.resolve_backward(host_array(grad_resolved), grad_image.numpy(), anti_aliasing, num_threads())
    return grad_image.to(grad_resolved.device)


@torch.library.register_fake(resolve_backward)
def _(grad_resolved, anti_aliasing):
    return grad_resolved.new_empty(_raster_shape(grad_resolved, anti_aliasing))


register_autograd(resolve_backward, no_second_derivative("render"))


@operator
def edges_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    owner: Tensor,
    image: Tensor,
    grad_image: Tensor,
    eps: float,
) -> Tensor:
    """NMR's gradient of raster pixels ``[B, H, W, C]``, per vertex, of the shape of ``vertices``; zero in z."""
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    arrays = vertices, faces, starts, owner, image, grad_image
    _C.edges_backward(*map(host_array, arrays), grad_vertices.numpy(), eps, num_threads())
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(edges_backward)
def _(vertices, faces, starts, owner, image, grad_image, eps):
    return vertices.new_empty(vertices.shape)


register_autograd(edges_backward, no_second_derivative("render"))
