"""Operators: the pose of a camera, and vertices from world space to renderer space."""

# No `from __future__ import annotations` here: torch 2.4 reads the operators' types from the annotations themselves.
from typing import List, Optional  # noqa: UP035

import torch
from torch import Tensor

from ._host import _C, host_array, no_second_derivative, num_threads

# --- pose


@torch.library.custom_op("nmr::pose", mutates_args=())
def pose(forward: Tensor, up: Tensor) -> Tensor:
    """``[B, 3, 4]`` from directions and up vectors ``[B, 3]``: rows x, -y, z of the camera; no translation."""
    matrix = torch.empty((forward.shape[0], 3, 4), dtype=forward.dtype)
    _C.pose_forward(host_array(forward), host_array(up), matrix.numpy())
    return matrix.to(forward.device)


@pose.register_fake
def _(forward, up):
    return forward.new_empty((forward.shape[0], 3, 4))


def _pose_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _pose_backward(ctx, grad_matrix):
    return pose_backward(*ctx.saved_tensors, grad_matrix)


pose.register_autograd(_pose_backward, setup_context=_pose_setup)


@torch.library.custom_op("nmr::pose_backward", mutates_args=())
def pose_backward(forward: Tensor, up: Tensor, grad_matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of :func:`pose` to its two arguments, ``[B, 3]``."""
    grad_forward, grad_up = torch.empty(forward.shape, dtype=forward.dtype), torch.empty(up.shape, dtype=up.dtype)
    arrays = host_array(forward), host_array(up), host_array(grad_matrix)
    _C.pose_backward(*arrays, grad_forward.numpy(), grad_up.numpy())
    return grad_forward.to(forward.device), grad_up.to(up.device)


@pose_backward.register_fake
def _(forward, up, grad_matrix):
    return forward.new_empty(forward.shape), up.new_empty(up.shape)


pose_backward.register_autograd(no_second_derivative("a camera's transform"))


# --- project


@torch.library.custom_op("nmr::project", mutates_args=())
def project(
    vertices: Tensor,
    matrix: Tensor,
    intrinsics: Tensor,
    distortion: Optional[Tensor],  # noqa: UP045
    origin: Optional[Tensor],  # noqa: UP045
    extent: Optional[Tensor],  # noqa: UP045
    starts: Optional[Tensor],  # noqa: UP045
    perspective: bool,
) -> Tensor:
    """Vertices ``[B or 1, V, 3]`` or packed ``[N, 3]`` in renderer space, ``[B, V, 3]`` or ``[N, 3]``.

    ``u = A (v - origin) + t`` with ``matrix [B, 3, 4] = [A | t]``, ``origin [B, 3]`` or None (0); ``p = (u_x, u_y)``,
    if perspective divided by u_z and distorted by ``distortion [B, 5]`` or None; divided by ``extent [B]`` or None (1);
    x and y are ``intrinsics [B, 2, 3]`` times ``(p_x, p_y, 1)``, z is u_z.
    """
    points = torch.empty(_points_shape(vertices, matrix, starts), dtype=vertices.dtype)
    arrays = [host_array(x) for x in (vertices, matrix, intrinsics, distortion, origin, extent, starts)]
    _C.project_forward(*arrays, points.numpy(), perspective, num_threads())
    return points.to(vertices.device)


def _points_shape(vertices, matrix, starts):
    return vertices.shape if starts is not None else (matrix.shape[0], *vertices.shape[1:])


@project.register_fake
def _(vertices, matrix, intrinsics, distortion, origin, extent, starts, perspective):
    return vertices.new_empty(_points_shape(vertices, matrix, starts))


def _project_setup(ctx, inputs, output):
    *tensors, ctx.perspective = inputs
    ctx.save_for_backward(*tensors)


def _project_backward(ctx, grad_points):
    wanted = list(ctx.needs_input_grad[:6])
    grads = iter(project_backward(*ctx.saved_tensors, ctx.perspective, grad_points, wanted))
    return *(next(grads) if want else None for want in wanted), None, None


project.register_autograd(_project_backward, setup_context=_project_setup)


@torch.library.custom_op("nmr::project_backward", mutates_args=())
def project_backward(
    vertices: Tensor,
    matrix: Tensor,
    intrinsics: Tensor,
    distortion: Optional[Tensor],  # noqa: UP045
    origin: Optional[Tensor],  # noqa: UP045
    extent: Optional[Tensor],  # noqa: UP045
    starts: Optional[Tensor],  # noqa: UP045
    perspective: bool,
    grad_points: Tensor,
    wanted: List[bool],  # noqa: UP006
) -> List[Tensor]:  # noqa: UP006
    """The gradients of :func:`project` that are wanted, of vertices, matrix, intrinsics, distortion, origin, extent."""
    inputs = vertices, matrix, intrinsics, distortion, origin, extent
    grads = [torch.empty(x.shape, dtype=x.dtype) if want else None for x, want in zip(inputs, wanted, strict=True)]
    arrays = [host_array(x) for x in (*inputs, starts, grad_points, *grads)]
    _C.project_backward(*arrays, perspective, num_threads())
    return [grad.to(vertices.device) for grad in grads if grad is not None]


@project_backward.register_fake
def _(vertices, matrix, intrinsics, distortion, origin, extent, starts, perspective, grad_points, wanted):
    inputs = vertices, matrix, intrinsics, distortion, origin, extent
    return [x.new_empty(x.shape) for x, want in zip(inputs, wanted, strict=True) if want]


project_backward.register_autograd(no_second_derivative("a camera's transform"))
