"""Operators: the soft silhouette of SoftRas."""

import torch
from torch import Tensor

from ._host import _C, batch_size, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd


@operator
def soft_silhouette(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    height: int,
    width: int,
    fill_back: bool,
    near: float,
    far: float,
    sigma: float,
    reach: float,
) -> Tensor:
    """``1 - alpha`` at each raster pixel, ``[B, height, width]``: the product of 1 - D over all faces."""
    clear = host_empty((batch_size(vertices, starts), height, width), dtype=vertices.dtype)
    arrays = host_array(vertices), host_array(faces), host_array(starts)
    _C.soft_forward(*arrays, clear.numpy(), fill_back, near, far, sigma, reach, num_threads())
    return clear.to(vertices.device)


@torch.library.register_fake(soft_silhouette.op)
def _(vertices, faces, starts, height, width, fill_back, near, far, sigma, reach):
    return vertices.new_empty((batch_size(vertices, starts), height, width))


def _soft_setup(ctx, inputs, output):
    vertices, faces, starts, _, _, *ctx.settings = inputs
    ctx.save_for_backward(vertices, faces, starts, output)


def _soft_backward(ctx, grad_clear):
    return soft_silhouette_backward(*ctx.saved_tensors, grad_clear, *ctx.settings), *(None,) * 9


register_autograd(soft_silhouette, _soft_backward, setup_context=_soft_setup)


@operator
def soft_silhouette_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    clear: Tensor,
    grad_clear: Tensor,
    fill_back: bool,
    near: float,
    far: float,
    sigma: float,
    reach: float,
) -> Tensor:
    """Gradient of :func:`soft_silhouette`, of the shape of ``vertices``; zero in z."""
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    arrays = (host_array(x) for x in (vertices, faces, starts, clear, grad_clear, grad_vertices))
    _C.soft_backward(*arrays, fill_back, near, far, sigma, reach, num_threads())
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(soft_silhouette_backward.op)
def _(vertices, faces, starts, clear, grad_clear, fill_back, near, far, sigma, reach):
    return vertices.new_empty(vertices.shape)


register_autograd(soft_silhouette_backward, no_second_derivative("render_soft_silhouette"))
