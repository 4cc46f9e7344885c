"""Base class of mesh generators: the faces of a fixed topology, and mirror symmetry about a vertical plane."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

import nmr

#: The mirror plane x = 0 or z = 0, or the vertical plane along which a camera of this azimuth in degrees looks
#: (x = 0 is 0, z = 0 is 90).
Symmetry = Literal["x", "z"] | Annotated[float, Field(ge=-360, le=360)]
#: The setting; auto: the plane that the training masks show (`data.mirror_plane`). None: no symmetry.
SymmetryOption = Symmetry | Literal["auto"] | None


class MeshGenerator(nn.Module):
    """Shape code [B,512] -> vertices float32 [B,V,3] in the object frame (y up).

    If `symmetry` is not None, a subclass computes vertices that are symmetric about z = 0, and `place` turns them about
    the vertical axis to the plane `symmetry`.
    """

    faces: Tensor  # int64 [F,3]
    edges: Tensor  # int64 [E,4]: the table of `nmr.edge_table`
    mirror: Tensor | None  # int64 [V]: index of each vertex's mirror image; None: no symmetry
    rotation: Tensor | None  # float32 [3,3]: turns the plane z = 0 to the plane `symmetry`; None: they are the same

    def __init__(self, points: Tensor, faces: Tensor, symmetry: Symmetry | None) -> None:
        super().__init__()
        mirror = None if symmetry is None else mirror_images(points)
        rotation = None if symmetry in (None, "z") else _rotation(0.0 if symmetry == "x" else float(symmetry))
        tables = {"faces": faces, "edges": nmr.edge_table(faces), "mirror": mirror, "rotation": rotation}
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def place(self, vertices: Tensor) -> Tensor:
        """Turn vertices that are symmetric about z = 0 to the plane `symmetry`."""
        if self.rotation is None:
            return vertices
        return (vertices[..., None] * self.rotation).sum(-2)  # autocast would round a matrix product to bf16

    def symmetrized(self, vertices: Tensor) -> Tensor:
        """The mean of placed vertices [B,V,3] and their mirror images; `vertices` without symmetry."""
        if self.mirror is None:
            return vertices
        reflection = self.reflection.to(vertices)
        mirrored = (vertices[:, self.mirror.to(vertices.device), :, None] * reflection).sum(-2)
        return (vertices + mirrored) / 2

    @property
    def reflection(self) -> Tensor | None:
        """The reflection float32 [3,3] that maps placed shapes to themselves; None without symmetry."""
        if self.mirror is None:
            return None
        turn = torch.eye(3) if self.rotation is None else self.rotation.cpu()
        return turn.T @ torch.diag(torch.tensor([1.0, 1.0, -1.0])) @ turn


def mirror_images(points: Tensor) -> Tensor:
    """Index of the mirror image at z = 0 of each of the points [V,3], int64 [V]."""
    mirrored = points * torch.tensor([1.0, 1.0, -1.0]).to(points)
    return torch.cdist(mirrored.double(), points.double()).argmin(dim=1)


def _rotation(azimuth_deg: float) -> Tensor:
    """The rotation about y that turns the plane z = 0 to the one along which a camera of this azimuth looks."""
    angle = math.radians(azimuth_deg)
    sine, cosine = round(math.sin(angle), 12), round(math.cos(angle), 12)  # exact for quarter turns
    # The x axis is turned towards the eye, in direction (sin a, -cos a) of (x, z).
    return torch.tensor([[sine, 0.0, -cosine], [0.0, 1.0, 0.0], [cosine, 0.0, sine]])
