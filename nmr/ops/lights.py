"""Operators: normals of meshes, lit colours, and the viewers of images."""

import numpy as np
import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd

# --- normals


def _normals_shape(vertices, faces, smooth):
    return vertices.shape if smooth else (*vertices.shape[:-2], *faces.shape[-2:])


@operator
def normals(vertices: Tensor, faces: Tensor, starts: Tensor | None, smooth: bool) -> Tensor:
    """Unit normals ``n((v0 - v1) x (v2 - v1))`` of faces, ``[B or 1, F, 3]`` or packed ``[M, 3]``.

    smooth: normals of vertices, like ``vertices``: the direction of the sum of these products. 0 without an area.
    """
    result = host_empty(_normals_shape(vertices, faces, smooth), dtype=vertices.dtype)
    _C.normals_forward(*map(host_array, (vertices, faces, starts)), smooth, result.numpy(), num_threads())
    return result.to(vertices.device)


@torch.library.register_fake(normals.op)
def _(vertices, faces, starts, smooth):
    return vertices.new_empty(_normals_shape(vertices, faces, smooth))


def _normals_setup(ctx, inputs, output):
    *tensors, ctx.smooth = inputs
    ctx.save_for_backward(*tensors)


def _normals_backward(ctx, grad_normals):
    return normals_backward(*ctx.saved_tensors, ctx.smooth, grad_normals), None, None, None


register_autograd(normals, _normals_backward, _normals_setup)


@operator
def normals_backward(
    vertices: Tensor, faces: Tensor, starts: Tensor | None, smooth: bool, grad_normals: Tensor
) -> Tensor:
    """Gradient of :func:`normals` in its vertices."""
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    arrays = map(host_array, (vertices, faces, starts))
    _C.normals_backward(*arrays, smooth, host_array(grad_normals), grad_vertices.numpy(), num_threads())
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(normals_backward.op)
def _(vertices, faces, starts, smooth, grad_normals):
    return torch.empty_like(vertices, memory_format=torch.contiguous_format)


register_autograd(normals_backward, no_second_derivative("render_normals"))


# --- lights


@operator
def lit(
    colors: Tensor | None,
    normals: Tensor,
    parameters: Tensor | None,
    layout: Tensor,
    viewer: Tensor,
    vertices: Tensor,
    faces: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    smooth: bool,
) -> Tensor:
    """Lit colours ``[B, H, W, 3]``; 0 on background. Without parameters, the normals.

    colors are ``[B, H, W, 1 or 3]``, None is white; normals those of :func:`normals`; parameters ``[P]`` all values of
    lights, and layout int64 ``[11, 3]`` the place of each: first value, rows (1 or B), lights; viewer ``[B, 5]``: see
    :func:`viewer_of`; vertices and faces the meshes in world space.
    """
    result = host_empty((*face_index.shape, 3), dtype=weights.dtype)
    arrays = colors, normals, parameters, layout, viewer, vertices, faces, face_index, weights, starts
    _C.lit_forward(*map(host_array, arrays), smooth, result.numpy(), num_threads())
    return result.to(weights.device)


@torch.library.register_fake(lit.op)
def _(colors, normals, parameters, layout, viewer, vertices, faces, face_index, weights, starts, smooth):
    return weights.new_empty((*face_index.shape, 3))


def _lit_setup(ctx, inputs, output):
    *tensors, ctx.smooth = inputs
    ctx.save_for_backward(*tensors)


_DIFFERENTIABLE = (0, 1, 2, 5, 8)


def _lit_backward(ctx, grad_lit):
    needed = [ctx.needs_input_grad[n] for n in _DIFFERENTIABLE]
    grads = lit_backward(*ctx.saved_tensors, ctx.smooth, grad_lit, needed)
    result = [None] * 11
    for n, need, grad in zip(_DIFFERENTIABLE, needed, grads, strict=True):
        result[n] = grad if need else None
    return tuple(result)


register_autograd(lit, _lit_backward, _lit_setup)


@operator
def lit_backward(
    colors: Tensor | None,
    normals: Tensor,
    parameters: Tensor | None,
    layout: Tensor,
    viewer: Tensor,
    vertices: Tensor,
    faces: Tensor,
    face_index: Tensor,
    weights: Tensor,
    starts: Tensor | None,
    smooth: bool,
    grad_lit: Tensor,
    needed: list[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of :func:`lit` in colors, normals, parameters, vertices, weights; those not needed are empty."""
    like = colors, normals, parameters, vertices, weights
    grads = [host_empty(x.shape if need else 0, dtype=weights.dtype) for x, need in zip(like, needed, strict=True)]
    arrays = colors, normals, parameters, layout, viewer, vertices, faces, face_index, weights, starts
    outputs = (grad.numpy() if need else None for grad, need in zip(grads, needed, strict=True))
    _C.lit_backward(*map(host_array, arrays), smooth, host_array(grad_lit), *outputs, num_threads())
    return tuple(grad.to(weights.device) for grad in grads)


@torch.library.register_fake(lit_backward.op)
def _(
    colors, normals, parameters, layout, viewer, vertices, faces, face_index, weights, starts, smooth, grad_lit, needed
):
    like = colors, normals, parameters, vertices, weights
    return tuple(weights.new_empty(x.shape if need else 0) for x, need in zip(like, needed, strict=True))


register_autograd(lit_backward, no_second_derivative("render_rgb with lights"))


# --- the viewer


@operator
def viewer_of(matrix: Tensor, intrinsics: Tensor, origin: Tensor | None, perspective: bool) -> Tensor:
    """Viewers of images, ``[B, 5]``; the arguments are those of a :class:`nmr.cameras.Projection`.

    Three numbers and 1: the place of the eye; or three numbers and 0: the direction towards the viewer. Then -1 if the
    camera sees a right-handed world, else 1. Values that are not finite become 0. Computed in float64, in single
    operations, which round alike on every processor. No gradient.
    """
    A = host_array(matrix).astype(np.float64)
    x, y, z = A[:, 0, :3], A[:, 1, :3], A[:, 2, :3]

    def cross(a, b):
        return np.stack([a[:, i] * b[:, j] - a[:, j] * b[:, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1)

    def dot(a, b):
        return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]

    with np.errstate(all="ignore"):
        determinant = dot(cross(x, y), z)[:, None]
        columns = [column / determinant for column in (cross(y, z), cross(z, x), cross(x, y))]  # columns of the inverse
        K = host_array(intrinsics).astype(np.float64)
        flip = (K[:, 0, 0] * K[:, 1, 1] - K[:, 0, 1] * K[:, 1, 0])[:, None]
        if perspective:
            place = -sum(column * A[:, k, 3:] for k, column in enumerate(columns))
            place = place if origin is None else place + host_array(origin).astype(np.float64)
        else:
            place = -columns[2]
        side = np.where(np.sign(determinant) * np.sign(flip) < 0, -1.0, 1.0)
        result = np.concatenate(np.broadcast_arrays(*place.T[..., None], float(perspective), side), axis=1)
        result = result.astype(host_array(matrix).dtype)
    return torch.from_numpy(np.where(np.isfinite(result), result, 0)).to(matrix.device)


@torch.library.register_fake(viewer_of.op)
def _(matrix, intrinsics, origin, perspective):
    sizes = [x.shape[0] for x in (matrix, intrinsics, origin) if x is not None]
    return matrix.new_empty((max(sizes), 5))


register_autograd(viewer_of, lambda ctx, grad: (None,) * 4)
