"""Near-plane clipping: the meshes that are drawn in place of those that cross the plane, and the
way back to these.

The kernels then see a packed mesh in which faces are cut. Users see face indices and weights of
their own faces.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from . import ops
from ._packing import LARGEST_COORDINATE, MeshBatch, packed_starts
from .cameras import Camera
from .cameras.projection import ProjectingCamera

# Faces are cut at these shares of far: the first with near = 0 (the image of a point in the plane
# of the eye is infinitely large), the second with a positive near below it (nearer new vertices
# are too large for float32).
_NEAREST, _SMALLEST = 1e-5, 1e-8


class Clipped(NamedTuple):
    """The drawn meshes, packed, and the place of each drawn face on the face that it is part of."""

    mesh: MeshBatch
    source: Tensor  # int32 [M + 1]: face of the user's mesh; the last row is -1
    num_faces: int | Tensor  # faces of the user's meshes, as MeshBatch.num_faces
    corners: Tensor  # [M, 3]: rows of places
    places: Tensor  # packed [3 B + P, 3]: barycentric coordinates on the source
    place_starts: Tensor  # [B + 1, 2]: first of the places and first face of each mesh

    def face_index(self, face_index: Tensor) -> Tensor:
        """A face index map of the drawn meshes as one of the user's: ``[B, H, W]`` or
        ``[B, H, W, K]``.
        """
        one = (-1, *(1,) * (face_index.ndim - 1))
        drawn, num_faces = self.mesh.num_faces.view(one), self.num_faces
        num_faces = num_faces.view(one) if isinstance(num_faces, Tensor) else num_faces
        back = face_index >= drawn
        face = torch.where(back, face_index - drawn, face_index).long() + self.mesh.first_faces(
            0
        ).view(one)
        source = self.source[torch.where(face_index < 0, len(self.source) - 1, face)]
        return torch.where(back, source + num_faces, source)

    def weights(self, face_index: Tensor, weights: Tensor) -> Tensor:
        """Weights on the drawn faces ``[B, H, W, 3]`` (of their face index map) as weights on the
        user's faces.

        Both are linear in space: a point with weights b_k on a face with its corners at B_k has
        the weights sum_k b_k B_k.
        """
        return ops.interpolate(self.places, self.corners, face_index, weights, self.place_starts)


def clip_plane(near: float, far: float) -> float:
    """The depth of the clipping plane: faces are cut there, and nothing nearer is drawn."""
    return max(float(near), (_SMALLEST if near else _NEAREST) * float(far))


def can_read() -> bool:
    """Whether values of tensors can be read: not in torch.compile and torch.func.vmap."""
    return not torch.compiler.is_compiling() and not torch._C._are_functorch_transforms_active()


def clip_near(
    world: Tensor, mesh: MeshBatch, camera: Camera | None, plane: float, nearest: Tensor | None
) -> Clipped | None:
    """Cuts the faces that cross z = plane and leaves out those behind it; None if the meshes may
    stay as they are.

    ``world`` and ``mesh`` are the meshes before and after the camera, ``nearest []`` the least
    depth of all vertices, if it is known. The new vertices are
    interpolated in the world and then go through the camera, so that gradients reach the corners
    of the cut edges.
    """
    room = _room(mesh, plane, nearest)
    if room is None:
        return None
    num_new, num_drawn = zip(*room, strict=True)
    new_starts = packed_starts(num_new, num_drawn)
    faces, source, corners, ends = ops.clip_faces(
        *mesh.arrays, plane, new_starts, sum(num_new), sum(num_drawn)
    )
    share, new = _new_vertices(world, mesh, camera, plane, ends[:, :2], new_starts)
    own = mesh.each_vertices()
    own_counts = mesh.vertex_counts or (mesh.vertices.shape[-2],) * mesh.batch
    vertices = torch.cat([x for pair in zip(own, new.split(num_new), strict=True) for x in pair])
    vertex_counts = tuple(v + n for v, n in zip(own_counts, num_new, strict=True))
    drawn = MeshBatch(
        vertices, faces, packed_starts(vertex_counts, num_drawn), vertex_counts, num_drawn
    )
    eye = torch.eye(3, dtype=vertices.dtype, device=vertices.device)
    places = (1 - share) * eye[ends[:, 2]] + share * eye[ends[:, 3]]
    places = torch.cat([x for part in places.split(num_new) for x in (eye, part)])
    place_starts = packed_starts([3 + n for n in num_new], num_drawn)
    source = torch.cat([source, source.new_full((1,), -1)])
    return Clipped(drawn, source, mesh.num_faces, corners, places, place_starts)


def _room(mesh: MeshBatch, plane: float, nearest: Tensor | None) -> list[tuple[int, int]] | None:
    """New vertices and drawn faces of each mesh; None if nothing is cut.

    Meshes whose values cannot be read get room for every face to be cut.
    """
    if can_read():
        depth = mesh.vertices.detach()[..., 2] if nearest is None else nearest
        return ops.clip_count(*mesh.arrays, plane).tolist() if (depth < plane).any() else None
    return [(2 * n, 2 * n) for n in mesh.face_counts or (mesh.faces.shape[-2],) * mesh.batch]


def _new_vertices(
    world: Tensor,
    mesh: MeshBatch,
    camera: Camera | None,
    plane: float,
    rows: Tensor,
    starts: Tensor,
) -> tuple[Tensor, Tensor]:
    """The new vertices between two rows of the vertices: how far from the first ``[P, 1]``, and
    in renderer space.
    """
    # the perspective image (x, y, z) of a point is linear in space as (x z, y z, z)
    if camera is None:
        ends = F.embedding(rows, mesh.vertices.reshape(-1, 3))
        finite = _moderate(ends).view(-1, 1, 1)
        ends = torch.where(finite, ends, torch.zeros_like(ends))  # no gradient is 0 * inf
        z = torch.where(finite, ends[..., 2:], float("nan"))
        ends = torch.cat([ends[..., :2] * z, z], dim=-1)
    else:
        shared = mesh.starts is None and world.shape[0] == 1
        ends = F.embedding(rows % world.shape[1] if shared else rows, world.reshape(-1, 3))
        if isinstance(camera, ProjectingCamera):
            # Without the division, also points in the plane of the eye have a depth, with a
            # gradient.
            flat = replace(camera.projection(world.dtype), perspective=False, distortion=None)
            z = flat.transform(ends.view(-1, 3), starts=2 * starts).view(-1, 2, 3)[..., 2:]
        else:
            z = F.embedding(rows, mesh.vertices.reshape(-1, 3))[..., 2:]
    usable = _moderate(ends) & _moderate(z)
    ends, z = (torch.where(usable.unsqueeze(-1), x, torch.zeros_like(x)) for x in (ends, z))
    share, points = cut_edges(ends, z, plane)
    if camera is None:
        points = torch.cat([points[:, :2] / plane, torch.full_like(points[:, 2:], plane)], dim=-1)
    elif mesh.starts is not None or isinstance(camera, ProjectingCamera):
        points = camera.transform(points, starts=starts)
    else:
        points = _transform_padded(points, world, mesh.batch, camera, starts)
    return share, torch.where(usable, points, float("inf"))


def cut_edges(ends: Tensor, depth: Tensor, plane: float) -> tuple[Tensor, Tensor]:
    """The points at depth ``plane`` of edges between ``ends [P, 2, C]`` at ``depth [P, 2, 1]``: how
    far from the first end ``[P, 1]``, and the points ``[P, C]``.
    """
    height = depth[:, 1] - depth[:, 0]
    share = (plane - depth[:, 0]) / torch.where(height == 0, torch.ones_like(height), height)
    return share, ends[:, 0] + share * (ends[:, 1] - ends[:, 0])


def _moderate(ends: Tensor) -> Tensor:
    """Whether both ends ``[P, 2, C]`` of an edge are finite and not huge: ``[P, 1]``."""
    return (ends.abs() < LARGEST_COORDINATE).flatten(1).all(1, keepdim=True)


def _transform_padded(
    points: Tensor, world: Tensor, batch: int, camera: Camera, starts: Tensor
) -> Tensor:
    """Packed points through a camera that takes batches ``[B, V, 3]`` only; vertices of the mesh
    fill the gaps.
    """
    counts = starts[:, 0].diff().tolist()
    fill = world[:, :1].expand(batch, max(counts), 3)
    parts = [
        torch.cat([x, gap[len(x) :]]) for x, gap in zip(points.split(counts), fill, strict=True)
    ]
    transformed = camera.transform(torch.stack(parts))
    return torch.cat([part[:n] for part, n in zip(transformed, counts, strict=True)])
