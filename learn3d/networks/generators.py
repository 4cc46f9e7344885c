"""Mesh generators that deform a sphere: shape codes -> vertices of an icosphere."""

from __future__ import annotations

import torch
from torch import Tensor, nn

import nmr
from learn3d.networks.encoders import CODE_SIZE
from learn3d.networks.layers import linear_layers
from learn3d.networks.mesh_generator import MeshGenerator, Symmetry

OBJECT_SCALE = 0.5


def deform_sphere(sphere: Tensor, displacement: Tensor) -> Tensor:
    """Vertices 0.5 * (sphere + displacement): [V,3] and [B,V,3] -> [B,V,3].

    The paper's text adds the displacement to the unit sphere itself. At the data set's camera a unit sphere covers the
    whole image, so no silhouette edge would be seen and nothing would be learnt; the published code has the factor 0.5.
    """
    return OBJECT_SCALE * (sphere + displacement)


class SphereGenerator(MeshGenerator):
    """Free vertices float32 [B,642,3]: a displacement for each vertex of the sphere.

    With `symmetry` 979 numbers are predicted instead of 1926 (published code of Peng et al. 2020 for Pascal3D+): x and
    y of the 32 vertices on the plane z = 0, which stay on it, and x, y, z of the 305 with z > 0; the other 305 are
    their mirror images.
    """

    sphere: Tensor  # float32 [642,3]
    source: Tensor  # int64 [642,3]: index of the output for each coordinate; the one after the last is 0
    sign: Tensor  # float32 [642,3]: -1 if the coordinate is the opposite of the output

    def __init__(self, symmetry: Symmetry | None = None) -> None:
        sphere, faces = nmr.icosphere(3)
        super().__init__(sphere, faces, symmetry)
        self.register_buffer("sphere", sphere.float(), persistent=False)
        self.outputs = sphere.numel()
        if symmetry is not None:
            self._share_outputs()
        self.layers = linear_layers(CODE_SIZE, 1024, 2048, self.outputs)

    def _share_outputs(self) -> None:
        middle, right = (torch.nonzero(chosen)[:, 0] for chosen in (self.sphere[:, 2] == 0, self.sphere[:, 2] > 0))
        self.outputs = 2 * len(middle) + 3 * len(right)
        source, sign = torch.full(self.sphere.shape, self.outputs), torch.ones_like(self.sphere)
        source[middle, :2] = torch.arange(2 * len(middle)).reshape(-1, 2)
        source[right] = torch.arange(2 * len(middle), self.outputs).reshape(-1, 3)
        source[self.mirror[right]] = source[right]
        sign[self.mirror[right], 2] = -1
        self.register_buffer("source", source, persistent=False)
        self.register_buffer("sign", sign, persistent=False)

    def forward(self, codes: Tensor) -> Tensor:
        displacement = self.layers(codes).float()
        if self.mirror is None:
            displacement = displacement.reshape(len(codes), -1, 3)
        else:
            displacement = nn.functional.pad(displacement, (0, 1))[:, self.source] * self.sign
        return self.place(deform_sphere(self.sphere, displacement))


class SmallSphereGenerator(SphereGenerator):
    """The same input and output with hidden layers of 1024: half the weights. For the package's model, small data sets
    and quick experiments. From no paper.
    """

    def __init__(self, symmetry: Symmetry | None = None) -> None:
        super().__init__(symmetry)
        self.layers = linear_layers(CODE_SIZE, 1024, 1024, self.outputs)


def deform_bounded_sphere(sphere: Tensor, bias: Tensor, centroid: Tensor) -> Tensor:
    """Vertices of Kato et al. 2018 (published code): [V,3], [B,V,3] and [B,3] -> [B,V,3] within [-0.5, 0.5].

    With b = 0.5 sphere and c = tanh(centroid): s = sign(b) sigmoid(logit(|b|) + bias) lies in (-1, 1), is stretched to
    (-1, c) and (c, 1) on its two sides, and halved: 0.5 (c + s (1 - sign(s) c)). So every vertex stays in its octant
    about c / 2. One on a coordinate plane of the sphere (b = 0) stays on it: logit(0) = -inf, and its gradient is 0.
    """
    base, center = OBJECT_SCALE * sphere, torch.tanh(centroid)[:, None]
    stretch = base.sign() * torch.sigmoid(torch.logit(base.abs()) + bias)
    return 0.5 * (center + stretch * (1 - base.sign() * center))


class BoundedGenerator(MeshGenerator):
    """Vertices float32 [B,642,3] in [-0.5, 0.5], each in its octant about a learnt centroid.

    Kato et al. 2018: 512-1024-2048, and from there the bias of every vertex and, times 0.1, the centroid. With
    `symmetry` the vertices with z < 0 are the mirror images of the others, and the centroid lies on the plane.
    """

    sphere: Tensor  # float32 [642,3]

    def __init__(self, symmetry: Symmetry | None = None) -> None:
        sphere, faces = nmr.icosphere(3)
        super().__init__(sphere, faces, symmetry)
        self.register_buffer("sphere", sphere.float(), persistent=False)
        self.layers = linear_layers(CODE_SIZE, 1024, 2048).append(nn.ReLU())
        self.bias = nn.Linear(2048, sphere.numel())
        self.centroid = nn.Linear(2048, 3)

    def forward(self, codes: Tensor) -> Tensor:
        features = self.layers(codes)
        bias = self.bias(features).float().reshape(len(codes), -1, 3)
        centroid = 0.1 * self.centroid(features).float()
        if self.mirror is None:
            return deform_bounded_sphere(self.sphere, bias, centroid)
        x, y, _ = centroid.unbind(1)
        vertices = deform_bounded_sphere(self.sphere, bias, torch.stack([x, y, torch.zeros_like(x)], dim=1))
        mirrored = torch.cat([vertices[..., :2], -vertices[..., 2:]], dim=2)[:, self.mirror]
        return self.place(torch.where(self.sphere[:, 2:] < 0, mirrored, vertices))
