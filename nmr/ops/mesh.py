"""Operators on meshes alone: the smoothness loss, and occupancy grids."""

# No `from __future__ import annotations` here: torch 2.4 reads the operators' types from the annotations themselves.
import torch
from torch import Tensor

from ._host import _C, host_array, no_second_derivative, num_threads

# --- smoothness


@torch.library.custom_op("nmr::smoothness", mutates_args=())
def smoothness(vertices: Tensor, edges: Tensor) -> Tensor:
    """Smoothness loss of each mesh, ``[B]``."""
    loss = torch.empty(vertices.shape[0], dtype=vertices.dtype)
    _C.smoothness_forward(host_array(vertices), host_array(edges), loss.numpy(), num_threads())
    return loss.to(vertices.device)


@smoothness.register_fake
def _(vertices, edges):
    return vertices.new_empty(vertices.shape[0])


def _smoothness_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _smoothness_backward(ctx, grad_loss):
    return smoothness_backward(*ctx.saved_tensors, grad_loss), None


smoothness.register_autograd(_smoothness_backward, setup_context=_smoothness_setup)


@torch.library.custom_op("nmr::smoothness_backward", mutates_args=())
def smoothness_backward(vertices: Tensor, edges: Tensor, grad_loss: Tensor) -> Tensor:
    """Gradient of :func:`smoothness`, ``[B, V, 3]``."""
    grad_vertices = torch.empty(vertices.shape, dtype=vertices.dtype)
    _C.smoothness_backward(
        host_array(vertices),
        host_array(edges),
        host_array(grad_loss),
        grad_vertices.numpy(),
        num_threads(),
    )
    return grad_vertices.to(vertices.device)


@smoothness_backward.register_fake
def _(vertices, edges, grad_loss):
    return vertices.new_empty(vertices.shape)


smoothness_backward.register_autograd(no_second_derivative("smoothness_loss"))


# --- voxels


@torch.library.custom_op("nmr::voxels", mutates_args=())
def voxels(vertices: Tensor, faces: Tensor, size: int, touched: bool = False) -> Tensor:
    """Filled occupancy grids ``[B, s, s, s]`` (bool) of meshes in [0, 1]^3; not differentiable.

    The surface is defined by kato18 or, if ``touched``, by kato19 (every cell that a face touches).
    """
    grid = torch.empty((vertices.shape[0], size, size, size), dtype=torch.bool)
    _C.voxelize(host_array(vertices), host_array(faces), grid.numpy(), size, touched, num_threads())
    return grid.to(vertices.device)


@voxels.register_fake
def _(vertices, faces, size, touched=False):
    return vertices.new_empty((vertices.shape[0], size, size, size), dtype=torch.bool)
