"""Operators: meshes in clip space. Barycentric weights with their derivatives on the screen, and silhouette edges.

``positions [B or 1, V, 4]`` are (x, y, z, w), ``faces [F, 3]`` int64, face index maps int32 ``[B, H, W]``. Row 0 of all
images is the bottom.
"""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd

# --- weights


@operator
def clip_weights(positions: Tensor, faces: Tensor, face_index: Tensor) -> tuple[Tensor, Tensor]:
    """``[B, H, W, 4]`` (b_0, b_1, z / w, face + 1), and (db_0/dX, db_0/dY, db_1/dX, db_1/dY) in pixels.

    0 on background. z / w has no gradient.
    """
    rast, slopes = (host_empty((*face_index.shape, 4), dtype=positions.dtype) for _ in range(2))
    arrays = map(host_array, (positions, faces, face_index))
    _C.clip_weights_forward(*arrays, rast.numpy(), slopes.numpy(), num_threads())
    return rast.to(positions.device), slopes.to(positions.device)


@torch.library.register_fake(clip_weights.op)
def _(positions, faces, face_index):
    return tuple(positions.new_empty((*face_index.shape, 4)) for _ in range(2))


def _weights_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs)
    ctx.set_materialize_grads(False)


def _weights_backward(ctx, grad_rast, grad_slopes):
    if grad_rast is None and grad_slopes is None:
        return None, None, None
    if grad_rast is None:
        grad_rast = torch.zeros_like(grad_slopes)
    return clip_weights_backward(*ctx.saved_tensors, grad_rast, grad_slopes), None, None


register_autograd(clip_weights, _weights_backward, _weights_setup)


@operator
def clip_weights_backward(
    positions: Tensor, faces: Tensor, face_index: Tensor, grad_rast: Tensor, grad_slopes: Tensor | None
) -> Tensor:
    """Gradient of :func:`clip_weights`, of the shape of ``positions``; 0 in z."""
    grad = host_empty(positions.shape, dtype=positions.dtype)
    arrays = map(host_array, (positions, faces, face_index, grad_rast, grad_slopes))
    _C.clip_weights_backward(*arrays, grad.numpy(), num_threads())
    return grad.to(positions.device)


@torch.library.register_fake(clip_weights_backward.op)
def _(positions, faces, face_index, grad_rast, grad_slopes):
    return positions.new_empty(positions.shape)


register_autograd(clip_weights_backward, no_second_derivative("rasterize"))

# --- antialias


@operator
def antialias(
    colors: Tensor, rast: Tensor, positions: Tensor, faces: Tensor, face_index: Tensor, twins: Tensor
) -> Tensor:
    """Colours ``[B, H, W, C]`` blended between neighbours that a silhouette edge separates.

    ``rast`` is that of :func:`clip_weights`. ``twins [F, 3]`` int64: the edge opposite to corner k of face f is
    numbered 3 f + k; its entry is the next edge with the same two vertices, cyclically, or itself. Differentiable in
    colors and positions.
    """
    blended = host_empty(colors.shape, dtype=colors.dtype)
    arrays = map(host_array, (colors, rast, positions, faces, face_index, twins))
    _C.antialias_forward(*arrays, blended.numpy(), num_threads())
    return blended.to(colors.device)


@torch.library.register_fake(antialias.op)
def _(colors, rast, positions, faces, face_index, twins):
    return colors.new_empty(colors.shape)


def _antialias_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _antialias_backward(ctx, grad_blended):
    needed = [ctx.needs_input_grad[n] for n in (0, 2)]
    grads = antialias_backward(*ctx.saved_tensors, grad_blended, needed)
    of_colors, of_positions = (grad if need else None for grad, need in zip(grads, needed, strict=True))
    return of_colors, None, of_positions, None, None, None


register_autograd(antialias, _antialias_backward, _antialias_setup)


@operator
def antialias_backward(
    colors: Tensor,
    rast: Tensor,
    positions: Tensor,
    faces: Tensor,
    face_index: Tensor,
    twins: Tensor,
    grad_blended: Tensor,
    needed: list[bool],
) -> tuple[Tensor, Tensor]:
    """Gradients of :func:`antialias` in colors and positions; those that are not needed are empty."""
    like = colors, positions
    grads = [host_empty(x.shape if need else 0, dtype=x.dtype) for x, need in zip(like, needed, strict=True)]
    arrays = map(host_array, (colors, rast, positions, faces, face_index, twins, grad_blended))
    outputs = (grad.numpy() if need else None for grad, need in zip(grads, needed, strict=True))
    _C.antialias_backward(*arrays, *outputs, num_threads())
    return tuple(grad.to(colors.device) for grad in grads)


@torch.library.register_fake(antialias_backward.op)
def _(colors, rast, positions, faces, face_index, twins, grad_blended, needed):
    like = colors, positions
    return tuple(x.new_empty(x.shape if need else 0) for x, need in zip(like, needed, strict=True))


register_autograd(antialias_backward, no_second_derivative("antialias"))
