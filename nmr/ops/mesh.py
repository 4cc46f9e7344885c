"""Operators on meshes alone: the smoothness loss, and occupancy grids."""

import torch
from torch import Tensor

from ._host import _C, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd

# --- smoothness


@operator
def smoothness(vertices: Tensor, edges: Tensor) -> Tensor:
    """Smoothness loss of each mesh, ``[B]``."""
    loss = host_empty(vertices.shape[0], dtype=vertices.dtype)
    _C.smoothness_forward(host_array(vertices), host_array(edges), loss.numpy(), num_threads())
    return loss.to(vertices.device)


@torch.library.register_fake(smoothness.op)
def _(vertices, edges):
    return vertices.new_empty(vertices.shape[0])


def _smoothness_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _smoothness_backward(ctx, grad_loss):
    return smoothness_backward(*ctx.saved_tensors, grad_loss), None


register_autograd(smoothness, _smoothness_backward, _smoothness_setup)


@operator
def smoothness_backward(vertices: Tensor, edges: Tensor, grad_loss: Tensor) -> Tensor:
    """Gradient of :func:`smoothness`, ``[B, V, 3]``."""
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    _C.smoothness_backward(
        host_array(vertices),
        host_array(edges),
        host_array(grad_loss),
        grad_vertices.numpy(),
        num_threads(),
    )
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(smoothness_backward.op)
def _(vertices, edges, grad_loss):
    return vertices.new_empty(vertices.shape)


register_autograd(smoothness_backward, no_second_derivative("smoothness_loss"))


# --- voxels


@operator
def voxels(vertices: Tensor, faces: Tensor, size: int, touched: bool) -> Tensor:
    """Filled occupancy grids ``[B, s, s, s]`` (bool) of meshes in [0, 1]^3; not differentiable.

    The surface is defined by kato18 or, if ``touched``, by kato19 (every cell that a face touches).
    """
    grid = host_empty((vertices.shape[0], size, size, size), dtype=torch.bool)
    _C.voxelize(host_array(vertices), host_array(faces), grid.numpy(), size, touched, num_threads())
    return grid.to(vertices.device)


@torch.library.register_fake(voxels.op)
def _(vertices, faces, size, touched):
    return vertices.new_empty((vertices.shape[0], size, size, size), dtype=torch.bool)
