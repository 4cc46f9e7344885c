"""Operators: colours from texture cubes, and interpolation of values given at the corners of faces."""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd

# --- texture cubes


@operator
def sample_texture_cubes(
    textures: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    eps: float,
) -> Tensor:
    """Colours ``[B, H, W, C]`` from texture cubes; 0 on background.

    textures are ``[B or 1, F, ts, ts, ts, C]``, packed ``[M, ts, ts, ts, C]``.
    Axis k of a cube is the weight of the face's vertex k: sampled trilinearly at ``weights * (ts - 1)``, clamped to
    ``[0, ts - 1 - eps]``. Differentiable in ``textures`` only, as published.
    """
    colors = host_empty((*face_index.shape, textures.shape[-1]), dtype=textures.dtype)
    arrays = host_array(textures), host_array(face_index), host_array(weights), host_array(starts)
    _C.texture_cubes_forward(*arrays, colors.numpy(), eps, num_threads())
    return colors.to(textures.device)


@torch.library.register_fake(sample_texture_cubes.op)
def _(textures, face_index, weights, starts, eps):
    return textures.new_empty((*face_index.shape, textures.shape[-1]))


def _texture_cubes_setup(ctx, inputs, output):
    textures, face_index, weights, starts, eps = inputs
    ctx.save_for_backward(face_index, weights, starts)
    ctx.shape, ctx.eps = textures.shape, eps


def _texture_cubes_backward(ctx, grad_colors):
    grad_textures = None
    if ctx.needs_input_grad[0]:
        grad_textures = texture_cubes_backward(*ctx.saved_tensors, grad_colors, ctx.shape, ctx.eps)
    return grad_textures, None, None, None, None


register_autograd(sample_texture_cubes, _texture_cubes_backward, _texture_cubes_setup)


@operator
def texture_cubes_backward(
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    grad_colors: Tensor,
    shape: list[int],
    eps: float,
) -> Tensor:
    """Gradient of :func:`sample_texture_cubes` in its textures, of the given shape; shared ones sum over images."""
    grad_textures = host_empty(shape, dtype=grad_colors.dtype)
    arrays = face_index, weights, starts, grad_colors
    _C.texture_cubes_backward(*map(host_array, arrays), grad_textures.numpy(), eps, num_threads())
    return grad_textures.to(grad_colors.device)


@torch.library.register_fake(texture_cubes_backward.op)
def _(face_index, weights, starts, grad_colors, shape, eps):
    return grad_colors.new_empty(shape)


register_autograd(texture_cubes_backward, no_second_derivative("render_rgb"))


# --- interpolate


@operator
def interpolate(
    attributes: Tensor,
    corners: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
) -> Tensor:
    """``values[b, y, x] = sum_k weights[b, y, x, k] attributes[b, corners[f, k]]`` ``[B, H, W, C]``; 0 on background.

    attributes are ``[B or 1, N, C]``, packed ``[N, C]``; corners ``[F, 3]``, ``[B, F, 3]`` or packed ``[M, 3]`` are
    rows of them, counted from the first of the mesh; ``starts`` (packed) are first row and first face of each mesh.
    """
    values = host_empty((*face_index.shape, attributes.shape[-1]), dtype=attributes.dtype)
    arrays = attributes, corners, face_index, weights, starts
    _C.interpolate_forward(*map(host_array, arrays), values.numpy(), num_threads())
    return values.to(attributes.device)


@torch.library.register_fake(interpolate.op)
def _(attributes, corners, face_index, weights, starts):
    return attributes.new_empty((*face_index.shape, attributes.shape[-1]))


def _interpolate_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _interpolate_backward(ctx, grad_values):
    of_attributes, _, _, of_weights, _ = ctx.needs_input_grad
    grads = interpolate_backward(*ctx.saved_tensors, grad_values, of_attributes, of_weights)
    return grads[0] if of_attributes else None, None, None, grads[1] if of_weights else None, None


register_autograd(interpolate, _interpolate_backward, _interpolate_setup)


@operator
def interpolate_backward(
    attributes: Tensor,
    corners: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    grad_values: Tensor,
    of_attributes: bool,
    of_weights: bool,
) -> tuple[Tensor, Tensor]:
    """Gradients of :func:`interpolate` in attributes and weights; a gradient that is not requested is empty."""
    grad_attributes = host_empty(attributes.shape if of_attributes else 0, dtype=attributes.dtype)
    grad_weights = host_empty(weights.shape if of_weights else 0, dtype=attributes.dtype)
    arrays = attributes, corners, face_index, weights, starts, grad_values
    _C.interpolate_backward(
        *map(host_array, arrays),
        grad_attributes.numpy() if of_attributes else None,
        grad_weights.numpy() if of_weights else None,
        num_threads(),
    )
    return grad_attributes.to(attributes.device), grad_weights.to(attributes.device)


@torch.library.register_fake(interpolate_backward.op)
def _(attributes, corners, face_index, weights, starts, grad_values, of_attributes, of_weights):
    return (
        attributes.new_empty(attributes.shape if of_attributes else 0),
        attributes.new_empty(weights.shape if of_weights else 0),
    )


register_autograd(interpolate_backward, no_second_derivative("render_rgb"))
