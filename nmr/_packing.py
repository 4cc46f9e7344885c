"""Batches of meshes as the operators take them: stacked if they have one size, else packed end to
end.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from ._validate import cast_under_autocast, check_faces, check_vertices, describe

# A farther point counts as not finite: products of three coordinates, and with gradients, could
# overflow in float32.
LARGEST_COORDINATE = 1e12

# result of check_values: a tensor with a batch axis, or one tensor per mesh
Values = Tensor | tuple[Tensor, ...]


class MeshBatch(NamedTuple):
    """B meshes: vertices ``[B, V, 3]`` with faces ``[F, 3]`` or ``[B, F, 3]``, or packed
    ``[N, 3]`` and ``[M, 3]``.
    """

    vertices: Tensor
    faces: Tensor  # int64; vertex numbers count from the mesh's own first vertex
    # packed: int64 [B + 1, 2] on the host, first vertex and face of each mesh, then N, M
    starts: Tensor | None = None
    vertex_counts: tuple[int, ...] = ()  # packed: V of each mesh
    face_counts: tuple[int, ...] = ()  # packed: F of each mesh

    @property
    def arrays(self) -> tuple[Tensor, Tensor, Tensor | None]:
        """Vertices, faces and starts, as the operators take them."""
        return self.vertices, self.faces, self.starts

    @property
    def batch(self) -> int:
        return self.vertices.shape[0] if self.starts is None else len(self.vertex_counts)

    def each_vertices(self) -> tuple[Tensor, ...]:
        """The vertices ``[V_b, 3]`` of each mesh."""
        return (
            self.vertices.unbind(0)
            if self.starts is None
            else self.vertices.split(self.vertex_counts)
        )

    @property
    def num_faces(self) -> int | Tensor:
        """F; of packed meshes int32 ``[B, 1, 1]``."""
        if self.starts is None:
            return self.faces.shape[-2]
        return torch.tensor(self.face_counts, dtype=torch.int32, device=self.faces.device).view(
            -1, 1, 1
        )

    def first_faces(self, value_batch: int) -> int | Tensor:
        """First face of each image, when per-face values ``[value_batch, F, ...]`` are laid end
        to end.
        """
        if self.starts is not None:
            return self.starts[:-1, 1].to(self.faces.device).view(-1, 1, 1)
        if value_batch == 1:
            return 0
        return (
            torch.arange(value_batch, device=self.faces.device).view(-1, 1, 1)
            * self.faces.shape[-2]
        )

    def values(self, values: Values, name: str, per: str | None = None) -> Tensor:
        """Values in the layout of these meshes, ``[B | 1, n, ...]`` or packed
        ``[sum of n_b, ...]``.

        ``per``: "vertex" or "face" if each of them needs one row; None allows any number of rows.
        """
        if self.starts is None:
            values = (
                torch.stack(self._one_size(values, name)) if isinstance(values, tuple) else values
            )
            if values.shape[0] not in (1, self.batch):
                sizes = "1" if self.batch == 1 else f"1 or {self.batch}"
                raise ValueError(
                    f"{name} must have batch size {sizes}, that of the images, got {describe(values)}"
                )
            wanted = {
                "vertex": self.vertices.shape[1],
                "face": self.faces.shape[-2],
                None: values.shape[1],
            }[per]
            if values.shape[1] != wanted:
                raise ValueError(
                    f"{name} must have one row per {per} ({wanted}), got {describe(values)}"
                )
            return values.to(self.vertices)
        rows = tuple(len(part) for part in self._one_per_mesh(values, name))
        wanted = {"vertex": self.vertex_counts, "face": self.face_counts, None: rows}[per]
        if rows != wanted:
            raise ValueError(
                f"{name} must have one row per {per} (the meshes have {list(wanted)}), got {list(rows)}"
            )
        return torch.cat(values).to(self.vertices)

    def corners(
        self, corners: object, attributes: Values, name: str
    ) -> tuple[Tensor, Tensor | None]:
        """Checks faces that index rows of attributes; returns (corners, starts) as the operators
        take them.
        """
        device = self.faces.device
        if self.starts is None:
            if is_list(corners):
                corners = torch.stack(
                    self._one_size([check_faces(part, 1, device, name) for part in corners], name)
                )
            corners = check_faces(corners, self.batch, device, name)
            if corners.shape[-2] != self.faces.shape[-2]:
                raise ValueError(
                    f"{name} must have one row per face ({self.faces.shape[-2]}), got {describe(corners)}"
                )
            return corners, None
        parts = [check_faces(part, 1, device, name) for part in self._one_per_mesh(corners, name)]
        rows = tuple(part.shape[0] for part in parts)
        if rows != self.face_counts or any(part.ndim != 2 for part in parts):
            raise ValueError(
                f"{name} must have one row [3] per face (the meshes have {list(self.face_counts)}), got {list(rows)}"
            )
        return torch.cat(parts), packed_starts([len(part) for part in attributes], rows)

    def _one_size(self, parts: Sequence[Tensor], name: str) -> tuple[Tensor, ...]:
        if len({part.shape for part in parts}) != 1:
            raise ValueError(
                f"{name} must have one size, as the meshes do, got {[list(p.shape) for p in parts]}"
            )
        return tuple(parts)

    def _one_per_mesh(self, parts: object, name: str) -> Sequence[Tensor]:
        if not is_list(parts) or len(parts) != self.batch:
            got = f"{len(parts)}" if is_list(parts) else describe(parts)
            raise ValueError(
                f"{name} must be a list of {self.batch} tensors, one per mesh, got {got}"
            )
        return parts


def packed_starts(rows: Sequence[int], faces: Sequence[int]) -> Tensor:
    """int64 ``[B + 1, 2]`` in host memory from the number of rows and faces of each mesh."""
    return torch.tensor(
        [[0, *accumulate(rows)], [0, *accumulate(faces)]], device="cpu"
    ).T.contiguous()


def is_list(value: object) -> bool:
    return isinstance(value, (list, tuple))


def as_tuple(values: Tensor | Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Values of each mesh of a list, or one tensor of all."""
    return tuple(values) if is_list(values) else (values,)


def pack_meshes(vertices: object, faces: object) -> MeshBatch:
    """Meshes given as lists, checked and laid end to end; a list of one becomes the batch
    ``[1, V, 3]``.
    """
    if hasattr(vertices, "face_material"):
        raise TypeError(
            "vertices must be tensors, got a mesh file; write (mesh.vertices, mesh.faces, camera, "
            "colors=nmr.Materials.from_mesh(mesh))"
        )
    if is_list(vertices):
        vertices = [cast_under_autocast(part) for part in vertices]
        for part in vertices:
            if not isinstance(part, Tensor):
                raise TypeError(
                    f"a list of vertices must hold tensors [V_b, 3], it holds {describe(part)}; use torch.as_tensor()"
                )
            check_vertices(part)
            if part.ndim != 2:
                raise ValueError(
                    f"a list of vertices must hold tensors [V_b, 3], it holds {describe(part)}"
                )
            if (part.dtype, part.device) != (vertices[0].dtype, vertices[0].device):
                raise ValueError(
                    "the meshes of a list must have one dtype and device, "
                    f"got {vertices[0].dtype} on {vertices[0].device} and {part.dtype} on {part.device}"
                )
    else:
        vertices = check_vertices(vertices).unbind(0)
    if isinstance(faces, Tensor):
        faces = faces.unbind(0) if faces.ndim == 3 else [faces] * len(vertices)
    if not is_list(faces) or len(faces) != len(vertices) or not len(vertices):
        got = f"of {len(faces)}" if is_list(faces) else describe(faces)
        raise ValueError(
            "a list of meshes must hold at least one mesh, and faces for each; "
            f"got vertices of {len(vertices)} meshes and faces {got}"
        )
    faces = [check_faces(part, 1, vertices[0].device) for part in faces]
    if any(part.ndim != 2 for part in faces):
        raise ValueError(
            f"a list of faces must hold tensors [F_b, 3], it holds {[list(p.shape) for p in faces]}"
        )
    if len(vertices) == 1:
        return MeshBatch(vertices[0].unsqueeze(0), faces[0])
    vertex_counts = tuple(len(part) for part in vertices)
    face_counts = tuple(len(part) for part in faces)
    starts = packed_starts(vertex_counts, face_counts)
    return MeshBatch(
        torch.cat(tuple(vertices)), torch.cat(faces), starts, vertex_counts, face_counts
    )
