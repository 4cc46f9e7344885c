"""Operators: barycentric weights and depth of the nearest face at each pixel, and depth images."""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd

# --- fragments


@operator
def fragments(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    far: float,
    perspective: bool,
) -> tuple[Tensor, Tensor]:
    """Weights ``[B, H, W, 3]``, in space, of the nearest face's own vertices 0, 1, 2, and depth ``[B, H, W]``.

    With ``perspective`` 1 / depth is linear on the screen, else depth itself. On the background the weights are 0 and
    the depth is ``far``. Both are differentiable in the vertices at fixed face indices.
    """
    weights = host_empty((*face_index.shape, 3), dtype=vertices.dtype)
    depth = host_empty(face_index.shape, dtype=vertices.dtype)
    arrays = host_array(vertices), host_array(faces), host_array(starts), host_array(face_index)
    _C.fragments_forward(*arrays, weights.numpy(), depth.numpy(), far, perspective, num_threads())
    return weights.to(vertices.device), depth.to(vertices.device)


@torch.library.register_fake(fragments.op)
def _(vertices, faces, starts, face_index, far, perspective):
    return vertices.new_empty((*face_index.shape, 3)), vertices.new_empty(face_index.shape)


def _fragments_setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:4])
    ctx.perspective = inputs[5]


def _fragments_backward(ctx, grad_weights, grad_depth):
    grad_vertices = None
    if grad_weights is not None or grad_depth is not None:
        grad_vertices = fragments_backward(*ctx.saved_tensors, grad_weights, grad_depth, ctx.perspective)
    return grad_vertices, None, None, None, None, None


register_autograd(fragments, _fragments_backward, _fragments_setup)


@operator
def fragments_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    grad_weights: Tensor | None,
    grad_depth: Tensor | None,
    perspective: bool,
) -> Tensor:
    """Gradient of :func:`fragments`, of the shape of ``vertices``; a gradient that is None counts as zero."""
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    arrays = vertices, faces, starts, face_index, grad_weights, grad_depth
    _C.fragments_backward(*map(host_array, arrays), grad_vertices.numpy(), perspective, num_threads())
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(fragments_backward.op)
def _(vertices, faces, starts, face_index, grad_weights, grad_depth, perspective):
    return vertices.new_empty(vertices.shape)


register_autograd(fragments_backward, no_second_derivative("render_fragments"))


# --- depth image


def _image_shape(face_index, anti_aliasing) -> tuple[int, int, int]:
    scale = 2 if anti_aliasing else 1
    return face_index.shape[0], face_index.shape[1] // scale, face_index.shape[2] // scale


@operator
def depth_image(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    anti_aliasing: bool,
    far: float,
    perspective: bool,
) -> Tensor:
    """Depth ``[B, h, w]`` of a face index map; with anti-aliasing the mean of 2x2 pixels, ``far`` mixed in.

    The same numbers as the depth of :func:`fragments`, with a true derivative at fixed face indices, but faster.
    """
    depth = host_empty(_image_shape(face_index, anti_aliasing), dtype=vertices.dtype)
    arrays = host_array(vertices), host_array(faces), host_array(starts), host_array(face_index)
    _C.depth_forward(*arrays, depth.numpy(), anti_aliasing, far, perspective, num_threads())
    return depth.to(vertices.device)


@torch.library.register_fake(depth_image.op)
def _(vertices, faces, starts, face_index, anti_aliasing, far, perspective):
    return vertices.new_empty(_image_shape(face_index, anti_aliasing))


def _depth_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:4])
    ctx.anti_aliasing, ctx.perspective = inputs[4], inputs[6]


def _depth_backward(ctx, grad_depth):
    return depth_backward(*ctx.saved_tensors, grad_depth, ctx.anti_aliasing, ctx.perspective), *(None,) * 6


register_autograd(depth_image, _depth_backward, _depth_setup)


@operator
def depth_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    grad_depth: Tensor,
    anti_aliasing: bool,
    perspective: bool,
) -> Tensor:
    """Gradient of :func:`depth_image`, of the shape of ``vertices``."""
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    arrays = vertices, faces, starts, face_index, grad_depth
    _C.depth_backward(*map(host_array, arrays), grad_vertices.numpy(), anti_aliasing, perspective, num_threads())
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(depth_backward.op)
def _(vertices, faces, starts, face_index, grad_depth, anti_aliasing, perspective):
    return vertices.new_empty(vertices.shape)


register_autograd(depth_backward, no_second_derivative("render_depth"))
