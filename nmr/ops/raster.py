"""Operators: which face is nearest at each pixel, and silhouettes with NMR's gradient or the local one."""

from typing import NamedTuple

import torch
from torch import Tensor

from ._host import _C, batch_size, host_array, host_empty, no_second_derivative, num_threads
from ._register import operator, register_autograd


class RasterSettings(NamedTuple):
    """The settings of a render, in the order of the operators' arguments."""

    height: int  # rows of the image
    width: int
    anti_aliasing: bool
    fill_back: bool
    near: float
    far: float
    eps: float
    perspective: bool  # 1 / depth is linear on the screen, else depth itself

    @property
    def raster(self) -> tuple[int, int]:
        scale = 2 if self.anti_aliasing else 1
        return scale * self.height, scale * self.width


def _face_index_map(vertices, faces, starts, height, width, fill_back, near, far, perspective) -> Tensor:
    face_index = host_empty((batch_size(vertices, starts), height, width), dtype=torch.int32)
    arrays = host_array(vertices), host_array(faces), host_array(starts)
    _C.rasterize(*arrays, face_index.numpy(), fill_back, near, far, perspective, num_threads())
    return face_index


# --- rasterize


@operator
def rasterize(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    height: int,
    width: int,
    fill_back: bool,
    near: float,
    far: float,
    perspective: bool,
) -> Tensor:
    """Face index map ``[B, height, width]`` of meshes in renderer space; not differentiable."""
    return _face_index_map(vertices, faces, starts, height, width, fill_back, near, far, perspective).to(
        vertices.device
    )


@torch.library.register_fake(rasterize.op)
def _(vertices, faces, starts, height, width, fill_back, near, far, perspective):
    return vertices.new_empty((batch_size(vertices, starts), height, width), dtype=torch.int32)


# --- rasterize_layers


@operator
def rasterize_layers(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    height: int,
    width: int,
    layers: int,
    fill_back: bool,
    near: float,
    far: float,
    perspective: bool,
) -> Tensor:
    """Face indices of the nearest surfaces at each pixel, ``[B, height, width, layers]``, nearest first, then -1."""
    face_index = host_empty((batch_size(vertices, starts), height, width, layers), dtype=torch.int32)
    arrays = host_array(vertices), host_array(faces), host_array(starts)
    _C.rasterize_layers(*arrays, face_index.numpy(), fill_back, near, far, perspective, num_threads())
    return face_index.to(vertices.device)


@torch.library.register_fake(rasterize_layers.op)
def _(vertices, faces, starts, height, width, layers, fill_back, near, far, perspective):
    return vertices.new_empty((batch_size(vertices, starts), height, width, layers), dtype=torch.int32)


# --- silhouette


@operator
def silhouette(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    height: int,
    width: int,
    anti_aliasing: bool,
    fill_back: bool,
    near: float,
    far: float,
    eps: float,
    perspective: bool,
    local: bool,
) -> tuple[Tensor, Tensor]:
    """Silhouettes ``alpha [B, height, width]`` and the face index map ``[B, H, W]`` of meshes in renderer space.

    Its gradient is :func:`silhouette_backward` or, if ``local``, :func:`local_gradient`.
    """
    scale = 2 if anti_aliasing else 1
    raster = scale * height, scale * width
    face_index = _face_index_map(vertices, faces, starts, *raster, fill_back, near, far, perspective)
    alpha = host_empty((face_index.shape[0], height, width), dtype=vertices.dtype)
    _C.silhouette_forward(face_index.numpy(), alpha.numpy(), anti_aliasing, num_threads())
    return alpha.to(vertices.device), face_index.to(vertices.device)


@torch.library.register_fake(silhouette.op)
def _(vertices, faces, starts, height, width, anti_aliasing, fill_back, near, far, eps, perspective, local):
    batch, scale = batch_size(vertices, starts), 2 if anti_aliasing else 1
    alpha = vertices.new_empty((batch, height, width))
    return alpha, vertices.new_empty((batch, scale * height, scale * width), dtype=torch.int32)


def _silhouette_setup(ctx, inputs, output):
    vertices, faces, starts, *settings, ctx.local = inputs
    face_index = output[1]
    ctx.mark_non_differentiable(face_index)
    ctx.set_materialize_grads(False)  # no zeros in the shape of the face index map
    ctx.save_for_backward(vertices, faces, starts, face_index)
    ctx.settings = RasterSettings(*settings)


def _silhouette_backward(ctx, grad_alpha, _grad_face_index):
    if grad_alpha is None:
        return (None,) * 12
    gradient = local_gradient if ctx.local else silhouette_backward
    settings = ctx.settings
    return gradient(*ctx.saved_tensors, grad_alpha, settings.anti_aliasing, settings.eps), *(None,) * 11


register_autograd(silhouette, _silhouette_backward, _silhouette_setup)


@operator
def silhouette_backward(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    grad_alpha: Tensor,
    anti_aliasing: bool,
    eps: float,
) -> Tensor:
    """NMR's silhouette gradient, per vertex, of the shape of ``vertices``; zero in z."""
    return _gradient(_C.silhouette_backward, vertices, faces, starts, face_index, grad_alpha, anti_aliasing, eps)


def _gradient(kernel, vertices, faces, starts, face_index, grad_alpha, anti_aliasing, eps) -> Tensor:
    grad_vertices = host_empty(vertices.shape, dtype=vertices.dtype)
    arrays = map(host_array, (vertices, faces, starts, face_index, grad_alpha))
    kernel(*arrays, grad_vertices.numpy(), anti_aliasing, eps, num_threads())
    return grad_vertices.to(vertices.device)


@torch.library.register_fake(silhouette_backward.op)
def _(vertices, faces, starts, face_index, grad_alpha, anti_aliasing, eps):
    return vertices.new_empty(vertices.shape)


register_autograd(silhouette_backward, no_second_derivative("render_silhouette"))


@operator
def local_gradient(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    face_index: Tensor,
    grad_alpha: Tensor,
    anti_aliasing: bool,
    eps: float,
) -> Tensor:
    """Kato and Harada's silhouette gradient, which reaches one pixel; of the shape of ``vertices``, zero in z."""
    return _gradient(_C.local_gradient, vertices, faces, starts, face_index, grad_alpha, anti_aliasing, eps)


@torch.library.register_fake(local_gradient.op)
def _(vertices, faces, starts, face_index, grad_alpha, anti_aliasing, eps):
    return vertices.new_empty(vertices.shape)


register_autograd(local_gradient, no_second_derivative("render_silhouette"))
