"""The torch operators behind the public functions: forward, fake, set-up and backward of each stand together.

The kernels take NumPy views of the tensors (zero-copy on the CPU). Tensors of other devices are staged through the
host and the results go back to the device. Arguments are trusted here; the public functions validate.
"""

# No `from __future__ import annotations` here: torch 2.4 reads the operators' types from the annotations themselves.
import torch
from torch import Tensor

try:
    from . import _C
except ImportError as error:
    raise ImportError(
        "the compiled part of nmr is missing: this is the source folder, or the installation failed; "
        "run `pip install .` in the repository and start Python elsewhere, or use `pip install -e .`"
    ) from error


def _host_array(tensor: Tensor):
    return tensor.detach().cpu().contiguous().numpy()


# --- silhouette


@torch.library.custom_op("nmr::silhouette", mutates_args=())
def silhouette(
    vertices: Tensor,
    faces: Tensor,
    image_size: int,
    anti_aliasing: bool,
    fill_back: bool,
    near: float,
    far: float,
    eps: float,
) -> tuple[Tensor, Tensor]:
    """Silhouettes and index maps of meshes in renderer space.

    Returns ``alpha [B, S, S]`` (row 0 = top) and ``face_index`` int32 ``[B, R, R]`` at raster resolution (row 0 =
    bottom, -1 = background, ``F + f`` = reversed copy of face f).
    """
    batch, raster_size = vertices.shape[0], image_size * (2 if anti_aliasing else 1)
    alpha = torch.empty((batch, image_size, image_size), dtype=vertices.dtype)
    face_index = torch.empty((batch, raster_size, raster_size), dtype=torch.int32)
    _C.silhouette_forward(
        _host_array(vertices),
        _host_array(faces),
        alpha.numpy(),
        face_index.numpy(),
        image_size,
        anti_aliasing,
        fill_back,
        near,
        far,
        torch.get_num_threads(),
    )
    return alpha.to(vertices.device), face_index.to(vertices.device)


@silhouette.register_fake
def _(vertices, faces, image_size, anti_aliasing, fill_back, near, far, eps):
    batch, raster_size = vertices.shape[0], image_size * (2 if anti_aliasing else 1)
    alpha = vertices.new_empty((batch, image_size, image_size))
    return alpha, vertices.new_empty((batch, raster_size, raster_size), dtype=torch.int32)


def _silhouette_setup(ctx, inputs, output):
    vertices, faces, image_size, anti_aliasing, _, _, _, eps = inputs
    face_index = output[1]
    ctx.mark_non_differentiable(face_index)
    ctx.save_for_backward(vertices, faces, face_index)
    ctx.settings = image_size, anti_aliasing, eps


def _silhouette_backward(ctx, grad_alpha, _grad_face_index):
    vertices, faces, face_index = ctx.saved_tensors
    grad_vertices = silhouette_backward(vertices, faces, face_index, grad_alpha, *ctx.settings)
    return grad_vertices, None, None, None, None, None, None, None


silhouette.register_autograd(_silhouette_backward, setup_context=_silhouette_setup)


@torch.library.custom_op("nmr::silhouette_backward", mutates_args=())
def silhouette_backward(
    vertices: Tensor,
    faces: Tensor,
    face_index: Tensor,
    grad_alpha: Tensor,
    image_size: int,
    anti_aliasing: bool,
    eps: float,
) -> Tensor:
    """NMR's silhouette gradient, per vertex: ``[B, V, 3]``, zero in z."""
    grad_vertices = torch.empty(vertices.shape, dtype=vertices.dtype)
    _C.silhouette_backward(
        _host_array(vertices),
        _host_array(faces),
        _host_array(face_index),
        _host_array(grad_alpha),
        grad_vertices.numpy(),
        image_size,
        anti_aliasing,
        eps,
        torch.get_num_threads(),
    )
    return grad_vertices.to(vertices.device)


@silhouette_backward.register_fake
def _(vertices, faces, face_index, grad_alpha, image_size, anti_aliasing, eps):
    return vertices.new_empty(vertices.shape)


# --- smoothness


@torch.library.custom_op("nmr::smoothness", mutates_args=())
def smoothness(vertices: Tensor, edges: Tensor) -> Tensor:
    """Smoothness loss of each mesh, ``[B]``."""
    loss = torch.empty(vertices.shape[0], dtype=vertices.dtype)
    _C.smoothness_forward(_host_array(vertices), _host_array(edges), loss.numpy(), torch.get_num_threads())
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
        _host_array(vertices),
        _host_array(edges),
        _host_array(grad_loss),
        grad_vertices.numpy(),
        torch.get_num_threads(),
    )
    return grad_vertices.to(vertices.device)


@smoothness_backward.register_fake
def _(vertices, edges, grad_loss):
    return vertices.new_empty(vertices.shape)


# --- no second derivatives


def _no_second_derivative(name):
    def backward(ctx, *grads):
        raise RuntimeError(
            f"{name} has no second derivative: its gradient is computed by a kernel that is not differentiable itself; "
            "call backward() without create_graph=True"
        )

    return backward


silhouette_backward.register_autograd(_no_second_derivative("render_silhouette"))
smoothness_backward.register_autograd(_no_second_derivative("smoothness_loss"))


# --- voxels


@torch.library.custom_op("nmr::voxels", mutates_args=())
def voxels(vertices: Tensor, faces: Tensor, size: int) -> Tensor:
    """Filled occupancy grids ``[B, s, s, s]`` (bool) of meshes in [0, 1]^3; not differentiable."""
    grid = torch.empty((vertices.shape[0], size, size, size), dtype=torch.bool)
    _C.voxelize(_host_array(vertices), _host_array(faces), grid.numpy(), size, torch.get_num_threads())
    return grid.to(vertices.device)


@voxels.register_fake
def _(vertices, faces, size):
    return vertices.new_empty((vertices.shape[0], size, size, size), dtype=torch.bool)
