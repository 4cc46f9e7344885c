"""Operators: the pose of a camera, and vertices from world space to renderer space."""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd

# --- pose


@operator
def pose(forward: Tensor, up: Tensor) -> Tensor:
    """``[B, 3, 4]`` from directions and up vectors ``[B, 3]``: rows x, -y, z of the camera; no translation."""
    matrix = host_empty((forward.shape[0], 3, 4), dtype=forward.dtype)
    _C.pose_forward(host_array(forward), host_array(up), matrix.numpy())
    return matrix.to(forward.device)


@torch.library.register_fake(pose.op)
def _(forward, up):
    return forward.new_empty((forward.shape[0], 3, 4))


def _pose_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _pose_backward(ctx, grad_matrix):
    return pose_backward(*ctx.saved_tensors, grad_matrix)


register_autograd(pose, _pose_backward, _pose_setup)


@operator
def pose_backward(forward: Tensor, up: Tensor, grad_matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of :func:`pose` to its two arguments, ``[B, 3]``."""
    grad_forward, grad_up = host_empty(forward.shape, dtype=forward.dtype), host_empty(up.shape, dtype=up.dtype)
    arrays = host_array(forward), host_array(up), host_array(grad_matrix)
    _C.pose_backward(*arrays, grad_forward.numpy(), grad_up.numpy())
    return grad_forward.to(forward.device), grad_up.to(up.device)


@torch.library.register_fake(pose_backward.op)
def _(forward, up, grad_matrix):
    return forward.new_empty(forward.shape), up.new_empty(up.shape)


register_autograd(pose_backward, no_second_derivative("a camera's transform"))


# --- project


@operator
def project(
    vertices: Tensor,
    matrix: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    origin: Tensor | None,
    extent: Tensor | None,
    starts: Tensor | None,
    perspective: bool,
) -> Tensor:
    """Vertices ``[B or 1, V, 3]`` or packed ``[N, 3]`` in renderer space, ``[B, V, 3]`` or ``[N, 3]``.

    ``u = A (v - origin) + t`` with ``matrix [B, 3, 4] = [A | t]``, ``origin [B, 3]`` or None (0); ``p = (u_x, u_y)``,
    if perspective divided by u_z and distorted by ``distortion`` ``[B, 4]``, ``[B, 5]``, ``[B, 8]`` or None;
    divided by ``extent [B]`` or None (1); x and y are ``intrinsics [B, 2, 3]`` times ``(p_x, p_y, 1)``, z is u_z.
    """
    points = host_empty(_points_shape(vertices, matrix, starts), dtype=vertices.dtype)
    arrays = [host_array(x) for x in (vertices, matrix, intrinsics, distortion, origin, extent, starts)]
    _C.project_forward(*arrays, points.numpy(), perspective, num_threads())
    return points.to(vertices.device)


def _points_shape(vertices, matrix, starts):
    return vertices.shape if starts is not None else (matrix.shape[0], *vertices.shape[1:])


@torch.library.register_fake(project.op)
def _(vertices, matrix, intrinsics, distortion, origin, extent, starts, perspective):
    return vertices.new_empty(_points_shape(vertices, matrix, starts))


def _project_setup(ctx, inputs, output):
    *tensors, ctx.perspective = inputs
    ctx.save_for_backward(*tensors)


def _project_backward(ctx, grad_points):
    wanted = list(ctx.needs_input_grad[:6])
    grads = project_backward(*ctx.saved_tensors, ctx.perspective, grad_points, wanted)
    return *(grad if want else None for grad, want in zip(grads, wanted, strict=True)), None, None


register_autograd(project, _project_backward, _project_setup)


@operator
def project_backward(
    vertices: Tensor,
    matrix: Tensor,
    intrinsics: Tensor,
    distortion: Tensor | None,
    origin: Tensor | None,
    extent: Tensor | None,
    starts: Tensor | None,
    perspective: bool,
    grad_points: Tensor,
    wanted: list[bool],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of :func:`project` to its first six arguments; those that are not wanted are empty."""
    inputs = vertices, matrix, intrinsics, distortion, origin, extent
    grads = [host_empty(x.shape, dtype=x.dtype) if want else None for x, want in zip(inputs, wanted, strict=True)]
    arrays = [host_array(x) for x in (*inputs, starts, grad_points, *grads)]
    _C.project_backward(*arrays, perspective, num_threads())
    return tuple((host_empty(0, vertices.dtype) if grad is None else grad).to(vertices.device) for grad in grads)


@torch.library.register_fake(project_backward.op)
def _(vertices, matrix, intrinsics, distortion, origin, extent, starts, perspective, grad_points, wanted):
    inputs = vertices, matrix, intrinsics, distortion, origin, extent
    return tuple(vertices.new_empty(x.shape if want else 0) for x, want in zip(inputs, wanted, strict=True))


register_autograd(project_backward, no_second_derivative("a camera's transform"))
