"""Mesh generators, shape codes -> vertices: deformed spheres, with mirror symmetry about a
vertical plane.
"""

import math
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

import nmr
from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.layers import linear_layers

#: The mirror plane x = 0 or z = 0, or the vertical plane along which a camera of this azimuth in degrees looks
#: (x = 0 is 0, z = 0 is 90).
Symmetry = Literal["x", "z"] | Annotated[float, Field(ge=-360, le=360)]
#: Values of the setting: a plane; "auto" for the plane that `data.mirror_plane` finds; None without symmetry.
SymmetryOption = Symmetry | Literal["auto"] | None


class MeshGenerator(nn.Module):
    """Shape code [B,512] -> vertices float32 [B,V,3] in the object frame (y up), on faces of a
    fixed topology.

    If `symmetry` is not None, a subclass computes vertices that are symmetric about z = 0, and
    `place` turns them about the vertical axis to the plane `symmetry`.
    """

    faces: Tensor  # int64 [F,3]
    edges: Tensor  # int64 [E,4]: the table of `nmr.edge_table`
    mirror: Tensor | None  # int64 [V]: index of each vertex's mirror image; None without symmetry
    # float32 [3,3]: turns the plane z = 0 to the plane `symmetry`; None if they are the same
    rotation: Tensor | None

    def __init__(self, points: Tensor, faces: Tensor, symmetry: Symmetry | None) -> None:
        super().__init__()
        tables = {"faces": faces, "edges": nmr.edge_table(faces), "mirror": None, "rotation": None}
        if symmetry is not None:
            mirrored = points * torch.tensor([1, 1, -1])
            tables["mirror"] = torch.cdist(mirrored.double(), points.double()).argmin(dim=1)
        if symmetry not in (None, "z"):
            angle = math.radians(0.0 if symmetry == "x" else symmetry)
            # exact for quarter turns
            sine = round(math.sin(angle), 12)
            cosine = round(math.cos(angle), 12)
            # The x axis is turned towards the eye, in direction (sin a, -cos a) of (x, z).
            tables["rotation"] = torch.tensor(
                [[sine, 0.0, -cosine], [0.0, 1.0, 0.0], [cosine, 0.0, sine]]
            )
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def place(self, vertices: Tensor) -> Tensor:
        """Turn vertices that are symmetric about z = 0 to the plane `symmetry`."""
        if self.rotation is None:
            return vertices
        # autocast would round a matrix product to bf16
        return (vertices[..., None] * self.rotation).sum(-2)

    def symmetrized(self, vertices: Tensor) -> Tensor:
        """The mean of placed vertices [B,V,3] and their mirror images; `vertices` without
        symmetry.
        """
        if self.mirror is None:
            return vertices
        mirrored = vertices[:, self.mirror.to(vertices.device), :, None] * self.reflection.to(
            vertices
        )
        return (vertices + mirrored.sum(-2)) / 2

    @property
    def reflection(self) -> Tensor | None:
        """The reflection float32 [3,3] that maps placed shapes to themselves; None without
        symmetry.
        """
        if self.mirror is None:
            return None
        turn = torch.eye(3) if self.rotation is None else self.rotation.cpu()
        return turn.T @ torch.diag(torch.tensor([1.0, 1.0, -1.0])) @ turn


def deform_sphere(sphere: Tensor, displacement: Tensor) -> Tensor:
    """Vertices 0.5 * (sphere + displacement): [V,3] and [B,V,3] -> [B,V,3].

    The paper's text adds the displacement to the unit sphere itself. At the data set's camera a
    unit sphere covers the whole image, so no silhouette edge would be seen and nothing would be
    learnt; the published code has the factor 0.5.
    """
    return 0.5 * (sphere + displacement)


class SphereGenerator(MeshGenerator):
    """Vertices float32 [B,642,3]: a displacement for each vertex of the sphere.

    With `symmetry` 979 numbers are predicted instead of 1926 (published code of Peng et al. 2020
    for Pascal3D+): x and y of the 32 vertices on the plane z = 0, which stay on it, and x, y, z
    of the 305 with z > 0; the other 305 are their mirror images.
    """

    sphere: Tensor  # float32 [642,3]
    # int64 [642,3]: index of each coordinate's output; the index after the last means 0
    source: Tensor
    sign: Tensor  # float32 [642,3]: -1 if the coordinate is the opposite of the output

    def __init__(self, symmetry: Symmetry | None = None) -> None:
        sphere, faces = nmr.icosphere(3)
        super().__init__(sphere, faces, symmetry)
        self.register_buffer("sphere", sphere.float(), persistent=False)
        self.outputs = sphere.numel()
        if symmetry is not None:
            middle, right = (
                torch.nonzero(side)[:, 0]
                for side in (self.sphere[:, 2] == 0, self.sphere[:, 2] > 0)
            )
            self.outputs = 2 * len(middle) + 3 * len(right)
            source = torch.full(self.sphere.shape, self.outputs)
            sign = torch.ones_like(self.sphere)
            source[middle, :2] = torch.arange(2 * len(middle)).reshape(-1, 2)
            source[right] = torch.arange(2 * len(middle), self.outputs).reshape(-1, 3)
            source[self.mirror[right]] = source[right]
            sign[self.mirror[right], 2] = -1
            self.register_buffer("source", source, persistent=False)
            self.register_buffer("sign", sign, persistent=False)
        self.layers = linear_layers(CODE_SIZE, 1024, 2048, self.outputs)

    def displacements(self, codes: Tensor) -> Tensor:
        """Displacement float32 [B,642,3] of every vertex of the sphere."""
        outputs = self.layers(codes).float()
        if self.mirror is None:
            return outputs.reshape(len(codes), -1, 3)
        return F.pad(outputs, (0, 1))[:, self.source] * self.sign

    def forward(self, codes: Tensor) -> Tensor:
        return self.place(deform_sphere(self.sphere, self.displacements(codes)))


class SmoothSphereGenerator(SphereGenerator):
    """SphereGenerator with the displacements D = M U of its outputs U, M = a I + (1 - a) (I + b
    L)^-1.

    L [642,642] is the graph Laplacian of the sphere, b = 3, a = 0.2. M keeps low frequencies over
    the sphere and reduces high ones to a fifth, so they are learnt more slowly: whole parts move
    before single vertices do, and the sphere hardly folds early in training (preconditioning
    after Nicolet et al. 2021, who have a = 0).
    """

    mixing: Tensor  # float32 [642,642]: M

    def __init__(self, symmetry: Symmetry | None = None) -> None:
        super().__init__(symmetry)
        identity = torch.eye(len(self.sphere), dtype=torch.float64)
        first, second = self.edges[:, :2].T
        neighbours = torch.zeros_like(identity)
        neighbours[first, second] = neighbours[second, first] = 1
        laplacian = torch.diag(neighbours.sum(1)) - neighbours
        free_share, stiffness = 0.2, 3.0
        mixing = free_share * identity + (1 - free_share) * torch.linalg.inv(
            identity + stiffness * laplacian
        )
        self.register_buffer("mixing", mixing.float(), persistent=False)

    def displacements(self, codes: Tensor) -> Tensor:
        free = super().displacements(codes)
        with torch.autocast(free.device.type, enabled=False):
            mixed = torch.einsum("vw,bwc->bvc", self.mixing, free)
        if self.mirror is None:
            return mixed
        side = self.sphere[:, 2:].sign()  # exact symmetry, not only up to rounding
        mirrored = mixed[:, self.mirror] * mixed.new_tensor([1.0, 1.0, -1.0])
        flat = mixed * mixed.new_tensor([1.0, 1.0, 0.0])
        return torch.where(side > 0, mixed, torch.where(side < 0, mirrored, flat))


class SmallSphereGenerator(SphereGenerator):
    """SphereGenerator with hidden layers of 1024, half the weights, for the package's model and
    small data sets.
    """

    def __init__(self, symmetry: Symmetry | None = None) -> None:
        super().__init__(symmetry)
        self.layers = linear_layers(CODE_SIZE, 1024, 1024, self.outputs)


GeneratorName = Literal["auto", "sphere", "sphere-smooth", "sphere-small"]
GENERATORS: dict[str, type[MeshGenerator]] = {
    "sphere": SphereGenerator,
    "sphere-smooth": SmoothSphereGenerator,
    "sphere-small": SmallSphereGenerator,
}
