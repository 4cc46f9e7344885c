"""Operators: texture images at uv coordinates, their mipmaps, and the level of each pixel.

Texels of several images, or of all levels of their mipmaps, are concatenated: ``[N, C]``. ``grids`` is int64
``[I, L, 3]`` in host memory: first texel, height and width of each level of each image; I is 1 or B.
"""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd

WRAPS = ("repeat", "clamp", "mirror")  # in the order of the kernel's numbers

# --- mipmaps


@operator
def mipmaps(texels: Tensor, grids: Tensor, count: int) -> Tensor:
    """All levels ``[count, C]`` of concatenated images ``[., C]``; each texel is the mean of those that it covers."""
    pyramid = host_empty((count, texels.shape[1]), dtype=texels.dtype)
    _C.mipmaps_forward(host_array(texels), host_array(grids), pyramid.numpy(), num_threads())
    return pyramid.to(texels.device)


@torch.library.register_fake(mipmaps.op)
def _(texels, grids, count):
    return texels.new_empty((count, texels.shape[1]))


def _mipmaps_setup(ctx, inputs, output):
    texels, grids, _ = inputs
    ctx.save_for_backward(grids)
    ctx.count = texels.shape[0]


def _mipmaps_backward(ctx, grad_pyramid):
    return mipmaps_backward(grad_pyramid, *ctx.saved_tensors, ctx.count), None, None


register_autograd(mipmaps, _mipmaps_backward, _mipmaps_setup)


@operator
def mipmaps_backward(grad_pyramid: Tensor, grids: Tensor, count: int) -> Tensor:
    """Gradient of :func:`mipmaps` in its ``count`` texels."""
    grad_texels = host_empty((count, grad_pyramid.shape[1]), dtype=grad_pyramid.dtype)
    _C.mipmaps_backward(host_array(grad_pyramid), host_array(grids), grad_texels.numpy(), num_threads())
    return grad_texels.to(grad_pyramid.device)


@torch.library.register_fake(mipmaps_backward.op)
def _(grad_pyramid, grids, count):
    return grad_pyramid.new_empty((count, grad_pyramid.shape[1]))


register_autograd(mipmaps_backward, no_second_derivative("render_rgb"))


# --- levels


@operator
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
    """The mipmap level of each pixel ``[B, H, W]``, OpenGL's; 0 on background. It has no gradient."""
    level = host_empty(face_index.shape, dtype=weights.dtype)
    arrays = vertices, faces, mesh_starts, uv, corners, face_index, weights, starts, grids
    _C.uv_levels(*map(host_array, arrays), level.numpy(), num_threads())
    return level.to(weights.device)


@torch.library.register_fake(uv_levels.op)
def _(vertices, faces, mesh_starts, uv, corners, face_index, weights, starts, grids):
    return weights.new_empty(face_index.shape)


def _no_gradient(ctx, grad_level):
    return (None,) * 9


register_autograd(uv_levels, _no_gradient)


# --- sampling


@operator
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

    uv, corners, face_index, weights and starts are those of :func:`nmr.ops.interpolate`. Bilinear on level 0, or linear
    between the two levels around ``level [B, H, W]``, a constant. wrap is an index of ``WRAPS``. Differentiable in
    texels, uv and weights.
    """
    colors = host_empty((*face_index.shape, texels.shape[-1]), dtype=texels.dtype)
    arrays = texels, grids, level, uv, corners, face_index, weights, starts
    _C.sample_uv_forward(*map(host_array, arrays), wrap, colors.numpy(), num_threads())
    return colors.to(texels.device)


@torch.library.register_fake(sample_uv.op)
def _(texels, grids, level, uv, corners, face_index, weights, starts, wrap):
    return texels.new_empty((*face_index.shape, texels.shape[-1]))


def _sample_uv_setup(ctx, inputs, output):
    *tensors, ctx.wrap = inputs
    ctx.save_for_backward(*tensors)


def _sample_uv_backward(ctx, grad_colors):
    needed = [ctx.needs_input_grad[n] for n in (0, 3, 6)]
    grads = sample_uv_backward(*ctx.saved_tensors, ctx.wrap, grad_colors, needed)
    of_texels, of_uv, of_weights = (grad if need else None for grad, need in zip(grads, needed, strict=True))
    return of_texels, None, None, of_uv, None, None, of_weights, None, None


register_autograd(sample_uv, _sample_uv_backward, _sample_uv_setup)


@operator
def sample_uv_backward(
    texels: Tensor,
    grids: Tensor,
    level: Tensor | None,
    uv: Tensor,
    corners: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    wrap: int,
    grad_colors: Tensor,
    needed: list[bool],
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of :func:`sample_uv` in texels, uv and weights; those that are not needed are empty."""
    like = texels, uv, weights
    grads = [host_empty(x.shape if need else 0, dtype=x.dtype) for x, need in zip(like, needed, strict=True)]
    arrays = texels, grids, level, uv, corners, face_index, weights, starts
    outputs = (grad.numpy() if need else None for grad, need in zip(grads, needed, strict=True))
    _C.sample_uv_backward(*map(host_array, arrays), wrap, host_array(grad_colors), *outputs, num_threads())
    return tuple(grad.to(texels.device) for grad in grads)


@torch.library.register_fake(sample_uv_backward.op)
def _(texels, grids, level, uv, corners, face_index, weights, starts, wrap, grad_colors, needed):
    like = texels, uv, weights
    return tuple(x.new_empty(x.shape if need else 0) for x, need in zip(like, needed, strict=True))


register_autograd(sample_uv_backward, no_second_derivative("render_rgb"))
