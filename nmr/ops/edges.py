"""Operators: from raster pixels to image pixels, with a gradient of the edges."""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd


def _image_shape(image, anti_aliasing) -> tuple[int, int, int, int]:
    scale = 2 if anti_aliasing else 1
    return image.shape[0], image.shape[1] // scale, image.shape[2] // scale, image.shape[3]


# --- resolve


@operator
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
    """The image ``[B, h, w, C]`` of raster pixels ``[B, H, W, C]``: the mean of 2x2 with anti-aliasing, else a copy.

    Pixels without a face have the colour ``background [B or 1, C]``; without it that in ``image``. The gradients in
    ``image`` and ``background`` are those of the mean. That in x and y of ``vertices`` is that of the edges, summed
    over channels: NMR's, or the local one, which needs to know whether the camera has ``perspective``.
    """
    resolved = host_empty(_image_shape(image, anti_aliasing), dtype=image.dtype)
    arrays = map(host_array, (image, background, face_index))
    _C.resolve_forward(*arrays, resolved.numpy(), anti_aliasing, num_threads())
    return resolved.to(image.device)


@torch.library.register_fake(resolve.op)
def _(image, background, vertices, faces, starts, face_index, anti_aliasing, eps, local, perspective):
    return image.new_empty(_image_shape(image, anti_aliasing))


def _resolve_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:6])
    ctx.settings = inputs[6:]


def _resolve_backward(ctx, grad_resolved):
    image, background, vertices, faces, starts, face_index = ctx.saved_tensors
    of_image, of_background, of_vertices = ctx.needs_input_grad[:3]
    grad_image = grad_background = grad_vertices = None
    if of_image or of_background:
        wanted = ctx.settings[0], of_image, of_background
        grad_image, grad_background = resolve_backward(grad_resolved, background, face_index, *wanted)
    if of_background and background.shape[0] == 1:
        grad_background = grad_background.sum(0, keepdim=True)
    if of_vertices:
        mesh = vertices, faces, starts, face_index
        grad_vertices = edges_backward(*mesh, image, background, grad_resolved, *ctx.settings)
    grads = grad_image if of_image else None, grad_background if of_background else None, grad_vertices
    return *grads, *(None,) * 7


register_autograd(resolve, _resolve_backward, _resolve_setup)


def _resolve_grad_shapes(grad_resolved, face_index, of_image, of_background):
    batch, channels = grad_resolved.shape[0], grad_resolved.shape[3]
    return (*face_index.shape, channels) if of_image else (0,), (batch, channels) if of_background else (0,)


@operator
def resolve_backward(
    grad_resolved: Tensor,
    background: Tensor | None,
    face_index: Tensor,
    anti_aliasing: bool,
    of_image: bool,
    of_background: bool,
) -> tuple[Tensor, Tensor]:
    """Gradients ``[B, H, W, C]`` and ``[B, C]`` of the mean in :func:`resolve`; one that is not requested is empty."""
    shapes = _resolve_grad_shapes(grad_resolved, face_index, of_image, of_background)
    grads = [host_empty(shape, dtype=grad_resolved.dtype) for shape in shapes]
    _C.resolve_backward(
        *map(host_array, (grad_resolved, background, face_index)),
        grads[0].numpy() if of_image else None,
        grads[1].numpy() if of_background else None,
        anti_aliasing,
        num_threads(),
    )
    return grads[0].to(grad_resolved.device), grads[1].to(grad_resolved.device)


@torch.library.register_fake(resolve_backward.op)
def _(grad_resolved, background, face_index, anti_aliasing, of_image, of_background):
    shapes = _resolve_grad_shapes(grad_resolved, face_index, of_image, of_background)
    return grad_resolved.new_empty(shapes[0]), grad_resolved.new_empty(shapes[1])


register_autograd(resolve_backward, no_second_derivative("render"))


@operator
def edges_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    image: Tensor,
    background: Tensor | None,
    grad_resolved: Tensor,
    anti_aliasing: bool,
    eps: float,
    local: bool,
    perspective: bool,
) -> Tensor:
    """The gradient of the edges from raster pixels ``[B, H, W, C]``, of the shape of ``vertices``; zero in z.

    NMR's: if an upstream gradient of an image is not finite, those of all its visible faces are NaN.
    """
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    arrays = map(host_array, (vertices, faces, starts, face_index, image, background, grad_resolved))
    _C.edges_backward(*arrays, grad_vertices.numpy(), anti_aliasing, eps, local, perspective, num_threads())
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(edges_backward.op)
def _(vertices, faces, starts, face_index, image, background, grad_resolved, anti_aliasing, eps, local, perspective):
    return vertices.new_empty(vertices.shape)


register_autograd(edges_backward, no_second_derivative("render"))
