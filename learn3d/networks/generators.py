"""Mesh generators, shape codes -> vertices: deformed spheres and cubes, with mirror symmetry
about a vertical plane.
"""

import math
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

import nmr
from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.layers import initialize_he, linear_layers, norm_relu

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


GRID_SIZE = 16  # vertices along an edge of the cube
INITIAL_RADIUS = 0.5
BOUND = 1.2  # coordinates lie between -BOUND and BOUND


def cube_surface(size: int = GRID_SIZE) -> tuple[Tensor, Tensor, Tensor]:
    """The surface of a grid of size^3 points: (points int64 [V,3], patches int64 [6,size,size],
    faces int64 [F,3]).

    patches[f, i, j] is the vertex at (i, j) of side f of the cube; sides share the vertices at
    edges and corners. Faces are counter-clockwise seen from outside. size = 16 gives V = 1352 and
    F = 2700.
    """
    grid = torch.cartesian_prod(*[torch.arange(size)] * 3)
    outside = ((grid == 0) | (grid == size - 1)).any(1)
    points = grid[outside]
    vertex = torch.full((size**3,), -1)
    vertex[outside] = torch.arange(len(points))
    vertex = vertex.view(size, size, size)
    patches = torch.stack([vertex.select(axis, end) for axis in range(3) for end in (0, size - 1)])
    faces = []
    for side, patch in enumerate(patches):
        a, b, c, d = patch[:-1, :-1], patch[1:, :-1], patch[1:, 1:], patch[:-1, 1:]
        # (first axis) x (second axis) of the patch is the third axis for x and z and its opposite for y.
        outwards = (side % 2 == 1) != (side // 2 == 1)
        corners = (a, b, c, a, c, d) if outwards else (a, c, b, a, d, c)
        faces.append(torch.stack(corners, dim=-1).view(-1, 3))
    return points, patches, torch.cat(faces)


class CubeGenerator(MeshGenerator):
    """Base class: vertices = object_scale * 1.2 * tanh(base + scale * bias), float32 [B,1352,3].

    `base` is a parameter that starts as the sphere of radius 0.5 (times object_scale); a subclass
    computes `bias`, the offsets [B,1352,3], from the codes. With `symmetry`, as published: z
    becomes |z|, each vertex becomes the mean of itself and its mirror image, and z gets the sign
    that the vertex has on the cube. The vertices are then exactly symmetric, but the faces'
    diagonals are not.
    """

    signs: Tensor  # float32 [V,3]: (1, 1, -1) if z < 0 on the cube, else 1

    def __init__(self, scale: float, object_scale: float, symmetry: Symmetry | None) -> None:
        points, patches, faces = cube_surface()
        centred = 2 * points.double() / (GRID_SIZE - 1) - 1
        super().__init__(centred, faces, symmetry)
        self.patches = patches
        self.scale = scale
        self.object_scale = object_scale
        sphere = centred / centred.norm(dim=1, keepdim=True)
        self.base = nn.Parameter(torch.atanh(INITIAL_RADIUS * sphere / BOUND).float())
        signs = torch.ones(len(points), 3)
        signs[centred[:, 2] < 0, 2] = -1
        self.register_buffer("signs", signs, persistent=False)

    def forward(self, codes: Tensor) -> Tensor:
        points = self.base + self.scale * self.bias(codes).float()
        if self.mirror is not None:
            points = torch.cat([points[..., :2], points[..., 2:].abs()], dim=-1)
            points = (points + points[:, self.mirror]) / 2
        vertices = self.object_scale * BOUND * torch.tanh(points)
        return vertices if self.mirror is None else self.place(vertices * self.signs)


class ConvCubeGenerator(CubeGenerator):
    """A stack of transposed convolutions for each side of the cube; shared vertices get the mean
    (ShapeNet).

    Each stack: linear to 512@2x2, three 3x3 transposed convolutions of stride 2 to 256, 128, 64
    channels, batch norm and ReLU after each of the four; 3x3 convolution to 3@16x16.
    """

    positions: Tensor  # int64 [V,3]: places of a vertex among the 6 * 16 * 16 outputs, padded with the first
    shares: Tensor  # float32 [V,3,1]: their weights 1, 1/2 or 1/3; 0 for the padding

    def __init__(
        self,
        symmetry: Symmetry | None = None,
        scale: float = 0.01,
        object_scale: float = 0.5,
        channels: int = 512,
    ) -> None:
        super().__init__(scale, object_scale, symmetry)
        self.sides = nn.ModuleList(_side_decoder(channels) for _ in self.patches)
        places: list[list[int]] = [[] for _ in self.base]
        for place, vertex in enumerate(self.patches.flatten().tolist()):
            places[vertex].append(place)
        positions = torch.tensor([[*p, *[p[0]] * (3 - len(p))] for p in places])
        shares = torch.tensor([[1 / len(p)] * len(p) + [0.0] * (3 - len(p)) for p in places])
        self.register_buffer("positions", positions, persistent=False)
        self.register_buffer("shares", shares[:, :, None], persistent=False)

    def bias(self, codes: Tensor) -> Tensor:
        sides = torch.stack([side(codes) for side in self.sides], dim=1)  # [B,6,3,16,16]
        outputs = sides.float().permute(0, 1, 3, 4, 2).flatten(1, 3)
        # A gather: unlike a scatter's, its sums have a fixed order on every device.
        return (outputs[:, self.positions] * self.shares).sum(2)


def _side_decoder(channels: int) -> nn.Sequential:
    layers: list[nn.Module] = [
        nn.Linear(CODE_SIZE, 4 * channels, bias=False),
        nn.Unflatten(1, (channels, 2, 2)),
    ]
    layers += norm_relu(channels)
    for width in (channels // 2, channels // 4, channels // 8):
        layers.append(
            nn.ConvTranspose2d(
                2 * width, width, 3, stride=2, padding=1, output_padding=1, bias=False
            )
        )
        layers += norm_relu(width)
    decoder = nn.Sequential(*layers, nn.Conv2d(width, 3, 3, padding=1))
    initialize_he(decoder)
    return decoder


class LinearCubeGenerator(CubeGenerator):
    """Linear layers 512-4096-4096-1352*3 with ReLU (Pascal3D+)."""

    def __init__(
        self,
        symmetry: Symmetry | None = None,
        scale: float = 0.1,
        object_scale: float = 1.0,
        channels: int = 4096,
    ) -> None:
        super().__init__(scale, object_scale, symmetry)
        self.layers = linear_layers(CODE_SIZE, channels, channels, self.base.numel())
        initialize_he(self)

    def bias(self, codes: Tensor) -> Tensor:
        return self.layers(codes).unflatten(1, (-1, 3))


GeneratorName = Literal["auto", "sphere", "sphere-smooth", "sphere-small", "cube-conv", "cube-fc"]
GENERATORS: dict[str, type[MeshGenerator]] = {
    "sphere": SphereGenerator,
    "sphere-smooth": SmoothSphereGenerator,
    "sphere-small": SmallSphereGenerator,
    "cube-conv": ConvCubeGenerator,
    "cube-fc": LinearCubeGenerator,
}
