"""Operators: barycentric weights and depth of the owner at each pixel, and depth images."""

# No `from __future__ import annotations` here: torch 2.4 reads the operators' types from the annotations themselves.
from typing import Optional

import torch
from torch import Tensor

from ._host import _C, host_array, no_second_derivative, num_threads

# --- fragments


@torch.library.custom_op("nmr::fragments", mutates_args=())
def fragments(
    vertices: Tensor,
    faces: Tensor,
    starts: Optional[Tensor],  # noqa: UP045
    owner: Tensor,
    far: float,
) -> tuple[Tensor, Tensor]:
    """Perspective-correct weights ``[B, H, W, 3]`` of the owner's own vertices 0, 1, 2, and depth ``[B, H, W]``.

    On the background the weights are 0 and the depth is ``far``. Both are differentiable in the vertices at a fixed
    owner.
    """
    weights = torch.empty((*owner.shape, 3), dtype=vertices.dtype)
    depth = torch.empty(owner.shape, dtype=vertices.dtype)
    arrays = host_array(vertices), host_array(faces), host_array(starts), host_array(owner)
    _C.fragments_forward(*arrays, weights.numpy(), depth.numpy(), far, num_threads())
    return weights.to(vertices.device), depth.to(vertices.device)


@fragments.register_fake
def _(vertices, faces, starts, owner, far):
    return vertices.new_empty((*owner.shape, 3)), vertices.new_empty(owner.shape)


def _fragments_setup(ctx, inputs, output):
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*inputs[:4])


def _fragments_backward(ctx, grad_weights, grad_depth):
    grad_vertices = None
    if grad_weights is not None or grad_depth is not None:
        grad_vertices = fragments_backward(*ctx.saved_tensors, grad_weights, grad_depth)
    return grad_vertices, None, None, None, None


fragments.register_autograd(_fragments_backward, setup_context=_fragments_setup)


@torch.library.custom_op("nmr::fragments_backward", mutates_args=())
def fragments_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Optional[Tensor],  # noqa: UP045
    owner: Tensor,
    grad_weights: Optional[Tensor],  # noqa: UP045
    grad_depth: Optional[Tensor],  # noqa: UP045
) -> Tensor:
    """Gradient of :func:`fragments`, of the shape of ``vertices``; a gradient that is None counts as zero."""
    grad_vertices = torch.empty(vertices.shape, dtype=vertices.dtype)
    arrays = vertices, faces, starts, owner, grad_weights, grad_depth
    _C.fragments_backward(*map(host_array, arrays), grad_vertices.numpy(), num_threads())
    return grad_vertices.to(vertices.device)


@fragments_backward.register_fake
def _(vertices, faces, starts, owner, grad_weights, grad_depth):
    return vertices.new_empty(vertices.shape)


fragments_backward.register_autograd(no_second_derivative("render_fragments"))


# --- depth image


def _image_shape(owner, anti_aliasing) -> tuple[int, int, int]:
    scale = 2 if anti_aliasing else 1
    return owner.shape[0], owner.shape[1] // scale, owner.shape[2] // scale


@torch.library.custom_op("nmr::depth_image", mutates_args=())
def depth_image(
    vertices: Tensor,
    faces: Tensor,
    starts: Optional[Tensor],  # noqa: UP045
    owner: Tensor,
    anti_aliasing: bool,
    far: float,
) -> Tensor:
    """Depth ``[B, h, w]`` of an owner map; with anti-aliasing the mean of 2x2 pixels, ``far`` mixed in.

    The same numbers as the depth of :func:`fragments`, with a true derivative at a fixed owner, but faster.
    """
    depth = torch.empty(_image_shape(owner, anti_aliasing), dtype=vertices.dtype)
    arrays = host_array(vertices), host_array(faces), host_array(starts), host_array(owner)
    _C.depth_forward(*arrays, depth.numpy(), anti_aliasing, far, num_threads())
    return depth.to(vertices.device)


@depth_image.register_fake
def _(vertices, faces, starts, owner, anti_aliasing, far):
    return vertices.new_empty(_image_shape(owner, anti_aliasing))


def _depth_setup(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:4])
    ctx.anti_aliasing = inputs[4]


def _depth_backward(ctx, grad_depth):
    return depth_backward(*ctx.saved_tensors, grad_depth, ctx.anti_aliasing), None, None, None, None, None


depth_image.register_autograd(_depth_backward, setup_context=_depth_setup)


@torch.library.custom_op("nmr::depth_backward", mutates_args=())
def depth_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Optional[Tensor],  # noqa: UP045
    owner: Tensor,
    grad_depth: Tensor,
    anti_aliasing: bool,
) -> Tensor:
    """Gradient of :func:`depth_image`, of the shape of ``vertices``."""
    grad_vertices = torch.empty(vertices.shape, dtype=vertices.dtype)
    arrays = vertices, faces, starts, owner, grad_depth
    _C.depth_backward(*map(host_array, arrays), grad_vertices.numpy(), anti_aliasing, num_threads())
    return grad_vertices.to(vertices.device)


@depth_backward.register_fake
def _(vertices, faces, starts, owner, grad_depth, anti_aliasing):
    return vertices.new_empty(vertices.shape)


depth_backward.register_autograd(no_second_derivative("render_depth"))
