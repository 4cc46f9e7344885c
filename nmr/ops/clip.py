"""Operators: faces that cross the near plane are cut. Only the topology; no gradients pass through here."""

import torch
from torch import Tensor

from ._host import _C, batch_size, host_array, host_empty, num_threads
from ._register import operator


@operator
def clip_count(vertices: Tensor, faces: Tensor, starts: Tensor | None, near: float) -> Tensor:
    """Room that the clipped meshes need: int64 ``[B, 2]`` in host memory, new vertices and drawn faces.

    A mesh that stays as it is has no new vertices, and all its faces are drawn.
    """
    counts = torch.zeros((batch_size(vertices, starts), 2), dtype=torch.int64, device="cpu")
    counts[:, 1] = faces.shape[-2] if starts is None else starts[:, 1].diff()
    arrays = host_array(vertices), host_array(faces), host_array(starts)
    _C.clip_count(*arrays, near, counts.numpy(), num_threads())
    return counts


@torch.library.register_fake(clip_count.op)
def _(vertices, faces, starts, near):
    return vertices.new_empty((batch_size(vertices, starts), 2), dtype=torch.int64, device="cpu")


@operator
def clip_faces(
    vertices: Tensor,
    faces: Tensor,
    starts: Tensor | None,
    near: float,
    new_starts: Tensor,
    num_new: int,
    num_drawn: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The faces to draw, packed: ``faces [M, 3]``, ``source [M]`` (int32), ``corners [M, 3]``, ``ends [P, 4]`` (int64).

    ``new_starts [B + 1, 2]`` in host memory are first new vertex and first drawn face of each mesh, then P = num_new
    and M = num_drawn. New vertices are numbered after the V of their mesh. ``source`` is the face that a drawn face is
    part of; ``corners`` says which of its corners are those of the source (0, 1, 2) or new vertices (3 + number);
    ``ends`` are the two rows of ``vertices.reshape(-1, 3)`` that a new vertex is between, and which corners of the
    source these are. Room that is left over is filled with faces without area.
    """
    drawn = host_empty((num_drawn, 3), dtype=torch.int64)
    source = host_empty((num_drawn,), dtype=torch.int32)
    corners = host_empty((num_drawn, 3), dtype=torch.int64)
    ends = host_empty((num_new, 4), dtype=torch.int64)
    arrays = [host_array(x) for x in (vertices, faces, starts)]
    results = drawn, source, corners, ends
    _C.clip_faces(*arrays, near, host_array(new_starts), *(x.numpy() for x in results), num_threads())
    return tuple(x.to(vertices.device) for x in results)


@torch.library.register_fake(clip_faces.op)
def _(vertices, faces, starts, near, new_starts, num_new, num_drawn):
    def indices(*shape, dtype=torch.int64):
        return vertices.new_empty(shape, dtype=dtype)

    return indices(num_drawn, 3), indices(num_drawn, dtype=torch.int32), indices(num_drawn, 3), indices(num_new, 4)
