"""Operators: the soft silhouette of SoftRas, and the faces around each pixel."""

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
    sigma: Tensor,
    fill_back: bool,
    near: float,
    far: float,
    reach_per_sigma: float,
) -> Tensor:
    """``1 - alpha`` at each raster pixel, ``[B, height, width]``: the product of 1 - D over all faces."""
    clear = host_empty((batch_size(vertices, starts), height, width), dtype=vertices.dtype)
    arrays = host_array(vertices), host_array(faces), host_array(starts)
    value = sigma.item()
    _C.soft_forward(*arrays, clear.numpy(), fill_back, near, far, value, value * reach_per_sigma, num_threads())
    return clear.to(vertices.device)


@torch.library.register_fake(soft_silhouette.op)
def _(vertices, faces, starts, height, width, sigma, fill_back, near, far, reach_per_sigma):
    return vertices.new_empty((batch_size(vertices, starts), height, width))


def _soft_setup(ctx, inputs, output):
    vertices, faces, starts, _, _, sigma, *ctx.settings = inputs
    ctx.save_for_backward(vertices, faces, starts, sigma, output)


def _soft_backward(ctx, grad_clear):
    grad_vertices, grad_sigma = soft_silhouette_backward(*ctx.saved_tensors, grad_clear, *ctx.settings)
    return grad_vertices, None, None, None, None, grad_sigma, *(None,) * 4


register_autograd(soft_silhouette, _soft_backward, setup_context=_soft_setup)


@operator
def soft_silhouette_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    sigma: Tensor,
    clear: Tensor,
    grad_clear: Tensor,
    fill_back: bool,
    near: float,
    far: float,
    reach_per_sigma: float,
) -> tuple[Tensor, Tensor]:
    """Gradients of :func:`soft_silhouette` in ``vertices`` (zero in z) and ``sigma``."""
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    grad_sigma = host_empty(clear.shape[:1], dtype=vertices.dtype)
    arrays = (host_array(x) for x in (vertices, faces, starts, clear, grad_clear, grad_vertices, grad_sigma))
    value = sigma.item()
    _C.soft_backward(*arrays, fill_back, near, far, value, value * reach_per_sigma, num_threads())
    return grad_vertices.to(vertices.device), grad_sigma.sum().to(sigma)


@torch.library.register_fake(soft_silhouette_backward.op)
def _(vertices, faces, starts, sigma, clear, grad_clear, fill_back, near, far, reach_per_sigma):
    return vertices.new_empty(vertices.shape), torch.empty_like(sigma)


register_autograd(soft_silhouette_backward, no_second_derivative("render_soft_silhouette"))


# --- the faces around each pixel


@operator
def soft_layers(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    height: int,
    width: int,
    layers: int,
    sigma: Tensor,
    fill_back: bool,
    near: float,
    far: float,
    perspective: bool,
    reach_per_sigma: float,
) -> Tensor:
    """Face indices ``[B, height, width, layers]`` of the nearest faces within reach, nearest first, then -1.

    Each face counts once: f if it is seen from its front, else F + f.
    """
    face_index = host_empty((batch_size(vertices, starts), height, width, layers), dtype=torch.int32)
    arrays = host_array(vertices), host_array(faces), host_array(starts)
    reach = sigma.item() * reach_per_sigma
    _C.soft_layers(*arrays, face_index.numpy(), fill_back, near, far, perspective, reach, num_threads())
    return face_index.to(vertices.device)


@torch.library.register_fake(soft_layers.op)
def _(vertices, faces, starts, height, width, layers, sigma, fill_back, near, far, perspective, reach_per_sigma):
    return vertices.new_empty((batch_size(vertices, starts), height, width, layers), dtype=torch.int32)


@operator
def soft_fragments(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    far: float,
    perspective: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Weights ``[B, H, W, K, 3]``, depth and distances ``[B, H, W, K]`` of a table of faces ``[B, H, W, K]``.

    Distances are those of pixels outside to the border of the face, squared, and minus those of pixels inside. A pixel
    outside has the weights on the screen that are clamped to [0, 1] and divided by their sum. All are differentiable.
    """
    sizes = (*face_index.shape, 3), face_index.shape, face_index.shape
    weights, depth, distances = (host_empty(size, dtype=vertices.dtype) for size in sizes)
    arrays = (host_array(x) for x in (vertices, faces, starts, face_index, weights, depth, distances))
    _C.soft_fragments_forward(*arrays, far, perspective, num_threads())
    return weights.to(vertices.device), depth.to(vertices.device), distances.to(vertices.device)


@torch.library.register_fake(soft_fragments.op)
def _(vertices, faces, starts, face_index, far, perspective):
    sizes = (*face_index.shape, 3), face_index.shape, face_index.shape
    return tuple(vertices.new_empty(size) for size in sizes)


def _fragments_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:4])
    ctx.perspective = inputs[5]


def _fragments_backward(ctx, *grads):
    return soft_fragments_backward(*ctx.saved_tensors, *grads, ctx.perspective), *(None,) * 5


register_autograd(soft_fragments, _fragments_backward, _fragments_setup)


@operator
def soft_fragments_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    grad_weights: Tensor,
    grad_depth: Tensor,
    grad_distances: Tensor,
    perspective: bool,
) -> Tensor:
    """Gradient of :func:`soft_fragments` in ``vertices``."""
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    arrays = vertices, faces, starts, face_index, grad_weights, grad_depth, grad_distances, grad_vertices
    _C.soft_fragments_backward(*map(host_array, arrays), perspective, num_threads())
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(soft_fragments_backward.op)
def _(vertices, faces, starts, face_index, grad_weights, grad_depth, grad_distances, perspective):
    return vertices.new_empty(vertices.shape)


register_autograd(soft_fragments_backward, no_second_derivative("render_soft_rgb"))
