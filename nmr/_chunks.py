"""Large batches are drawn a few images at a time, and shaded a second time in the backward pass.

Only the face indices of the raster are kept. Weights, normals and colours take ten times as much memory; those of a few
images stay in the caches.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ._packing import is_list
from ._validate import as_floats
from .cameras.projection import ProjectingCamera, Projection
from .lights import Lights
from .textures import FaceColors, NormalMap, TextureCubes, UVTexture, VertexColors

# Pixels of the raster that are shaded at once, and the least number of such chunks for which a batch is cut: uncut, it
# would keep 2 GB. Fewer are not worth the second shading, a fifth of the time if freed memory is kept by malloc.
RASTER_AT_ONCE, FEWEST_CHUNKS = 2**20, 32

# Axes that a field has if it holds a value for each image.
_AXES = {"matrix": 3, "intrinsics": 3, "distortion": 2, "origin": 2, "extent": 1}
_AXES |= {"colors": 3, "textures": 6, "image": 4, "uv": 3, "uv_faces": 3, "normals": 3, "harmonics": 3}
_AXES |= dict.fromkeys(("ambient", "specular", "shininess"), 1)
_AXES |= dict.fromkeys(("ambient_color", "directional", "point", "falloff"), 2)
_AXES |= dict.fromkeys(("directional_color", "direction", "point_color", "position"), 3)
_KNOWN = (Projection, Lights, VertexColors, FaceColors, TextureCubes, UVTexture, NormalMap)

Swap = Callable[[Tensor, slice | None], Tensor]  # gives the rows of a tensor, or all


@dataclass(frozen=True)
class Chunks:
    """Arguments of a rendering function and, as items, the ranges of images in which they are drawn."""

    arguments: tuple  # vertices, faces, camera, background, colors, lights
    batch: int
    size: int  # images in a chunk

    def __iter__(self):
        return (slice(first, first + self.size) for first in range(0, self.batch, self.size))

    def take(self, rows: slice, swap: Swap) -> list:
        """The arguments of some images, with each of their tensors swapped."""
        return [
            self._take(value, axes, rows, swap) for value, axes in zip(self.arguments, (3, 3, 0, 2, 0, 0), strict=True)
        ]

    def _take(self, value: object, axes: int, rows: slice, swap: Swap) -> object:
        count = _count(value, axes)
        if count not in (1, self.batch):
            raise _Unfit
        if isinstance(value, Tensor):
            return swap(value, None if count == 1 else rows)
        if is_list(value) and value and isinstance(value[0], Tensor):
            return [swap(part, None) for part in (value if count == 1 else value[rows])]
        if type(value) in _KNOWN:
            part = copy.copy(value)
            for field in fields(value):
                if field.name in _AXES:
                    of_field = self._take(getattr(value, field.name), _AXES[field.name], rows, swap)
                    object.__setattr__(part, field.name, of_field)
            return part
        if any(callable(getattr(value, name, None)) for name in ("sample", "transform", "shade")):
            raise _Unfit  # one's own: nobody knows its tensors
        return value


class _Unfit(Exception):
    """A value cannot be cut into the images of a batch."""


def make_chunks(arguments: tuple, image_size: tuple[int, int], anti_aliasing: bool) -> Chunks | None:
    """Chunks of (vertices, faces, camera, background, colors, lights), or None if all images are drawn at once.

    Colours and cameras of one's own are not cut, nor is anything in torch.compile, torch.func and torch.autocast.
    Values of a wrong size are left to the checks of the whole batch.
    """
    vertices, faces, camera, background, *shading = arguments
    first = vertices[0] if is_list(vertices) and vertices else vertices
    if torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active():
        return None
    if not isinstance(first, Tensor) or first.dtype not in (torch.float32, torch.float64):
        return None
    if torch.is_autocast_enabled(first.device.type):  # the second shading lies outside of it
        return None
    if isinstance(camera, ProjectingCamera):
        camera = camera.for_image(*image_size).projection(first.dtype)
    batch = max(_count(vertices, 3), _count(faces, 3), camera.batch if isinstance(camera, Projection) else 1)
    size = max(RASTER_AT_ONCE // (image_size[0] * image_size[1] * (4 if anti_aliasing else 1)), 1)
    if batch < FEWEST_CHUNKS * size:
        return None
    behind = as_floats(background, "background", "numbers")
    chunks = Chunks((vertices, faces, camera, behind, *shading), batch, size)
    try:
        chunks.take(slice(0, batch), lambda tensor, rows: tensor)
    except _Unfit:
        return None
    return chunks


def _count(value: object, axes: int) -> int:
    """The number of images for which there is a value; 1 also if it serves all."""
    listed = is_list(value) and len(value) and isinstance(value[0], Tensor)
    return len(value) if listed or (isinstance(value, Tensor) and value.ndim == axes) else 1


def draw_chunks(chunks: Chunks, rasterize: Callable, draw: Callable) -> dict[str, Tensor]:
    """The images ``{name: [B, ...]}`` of ``draw(*arguments, face_index)``, with ``rasterize(*arguments)`` kept."""
    tensors: dict[int, Tensor] = {}  # those that get a gradient

    def collect(tensor: Tensor, rows: slice | None) -> Tensor:
        if tensor.requires_grad and torch.is_grad_enabled():
            tensors[id(tensor)] = tensor
        return tensor

    chunks.take(slice(0, chunks.batch), collect)
    names: list[str] = []
    images = _Chunked.apply(chunks, rasterize, draw, names, list(tensors), *tensors.values())
    return dict(zip(names, images, strict=True))


class _Chunked(torch.autograd.Function):
    """All chunks, one after the other."""

    @staticmethod
    def forward(ctx, chunks, rasterize, draw, names, ids, *tensors):
        def part(tensor, rows):
            return tensor.detach() if rows is None else tensor.detach()[rows]

        ctx.chunks, ctx.draw, ctx.names, ctx.ids = chunks, draw, names, ids
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        # Face indices and images are allocated first, so that they do not fragment the memory that the chunks reuse.
        ctx.face_index = [rasterize(*chunks.take(rows, part)) for rows in chunks]
        images: dict[str, Tensor] = {}
        for rows, face_index in zip(chunks, ctx.face_index, strict=True):
            for name, image in draw(*chunks.take(rows, part), face_index).items():
                if rows.start == 0:
                    images[name] = image.new_empty(chunks.batch, *image.shape[1:])
                images[name][rows] = image
        names.extend(images)
        return tuple(images.values())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grad_images):
        place = {number: k for k, number in enumerate(ctx.ids)}
        tensors, grads = ctx.saved_tensors, [None] * len(ctx.ids)
        for rows, face_index in zip(ctx.chunks, ctx.face_index, strict=True):
            leaves: list[tuple[int, slice | None, Tensor]] = []

            def leaf(tensor, rows, leaves=leaves):
                k = place.get(id(tensor))
                tensor = (tensor if k is None else tensors[k]).detach()
                tensor = tensor if rows is None else tensor[rows]
                if k is not None:
                    leaves.append((k, rows, tensor.requires_grad_()))
                return tensor

            with torch.enable_grad():
                images = ctx.draw(*ctx.chunks.take(rows, leaf), face_index)
            grads_of = [
                (images[name], grad[rows])
                for name, grad in zip(ctx.names, grad_images, strict=True)
                if grad is not None
            ]
            grads_of = [(image, grad) for image, grad in grads_of if image.requires_grad]
            if not grads_of:
                continue
            outputs, of_outputs = zip(*grads_of, strict=True)
            found = torch.autograd.grad(outputs, [x for *_, x in leaves], of_outputs, allow_unused=True)
            del images, grads_of, outputs
            for (k, at, _), grad in zip(leaves, found, strict=True):
                if grad is not None and at is None:
                    grads[k] = grad if grads[k] is None else grads[k] + grad
                elif grad is not None:
                    grads[k] = torch.zeros_like(tensors[k]) if grads[k] is None else grads[k]
                    grads[k][at] += grad
        return *(None,) * 5, *grads
