"""Mesh generators: shape codes -> vertices of a surface of fixed topology."""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import nmr
from learn3d.networks.encoders import CODE_SIZE

OBJECT_SCALE = 0.5


def deform_sphere(sphere: Tensor, displacement: Tensor) -> Tensor:
    """Vertices 0.5 * (sphere + displacement): [V,3] and [B,V,3] -> [B,V,3].

    The paper's text adds the displacement to the unit sphere itself. At the data set's camera a unit sphere covers the
    whole image, so no silhouette edge would be seen and nothing would be learnt; the published code has the factor 0.5.
    """
    return OBJECT_SCALE * (sphere + displacement)


class SphereGenerator(nn.Module):
    """Shape code [B,512] -> vertices float32 [B,642,3] of a deformed icosphere, in the object frame (y up).

    `faces` int64 [1280,3] and `edges` int64 [1920,4] (the table of `nmr.edge_table`) describe the fixed topology.
    """

    sphere: Tensor
    faces: Tensor
    edges: Tensor

    def __init__(self) -> None:
        super().__init__()
        sphere, faces = nmr.icosphere(3)
        self.register_buffer("sphere", sphere.float(), persistent=False)
        self.register_buffer("faces", faces, persistent=False)
        self.register_buffer("edges", nmr.edge_table(faces), persistent=False)
        self.layers = nn.Sequential(
            nn.Linear(CODE_SIZE, 1024),
            nn.ReLU(),
            nn.Linear(1024, 2048),
            nn.ReLU(),
            nn.Linear(2048, sphere.shape[0] * 3),
        )

    def forward(self, codes: Tensor) -> Tensor:
        displacement = self.layers(codes).float().reshape(codes.shape[0], -1, 3)
        return deform_sphere(self.sphere, displacement)


def deform_bounded_sphere(sphere: Tensor, bias: Tensor, centroid: Tensor) -> Tensor:
    """Vertices of Kato et al. 2018 (published code): [V,3], [B,V,3] and [B,3] -> [B,V,3] within [-0.5, 0.5].

    With b = 0.5 sphere and c = tanh(centroid): s = sign(b) sigmoid(logit(|b|) + bias) lies in (-1, 1), is stretched to
    (-1, c) and (c, 1) on its two sides, and halved: 0.5 (c + s (1 - sign(s) c)). So every vertex stays in its octant
    about c / 2. One on a coordinate plane of the sphere (b = 0) stays on it: logit(0) = -inf, and its gradient is 0.
    """
    base, center = OBJECT_SCALE * sphere, torch.tanh(centroid)[:, None]
    stretch = base.sign() * torch.sigmoid(torch.logit(base.abs()) + bias)
    return 0.5 * (center + stretch * (1 - base.sign() * center))


class BoundedGenerator(nn.Module):
    """Shape code [B,512] -> vertices float32 [B,642,3] in [-0.5, 0.5], each in its octant about a learnt centroid.

    Kato et al. 2018: 512-1024-2048, and from there the bias of every vertex and, times 0.1, the centroid.
    `faces` and `edges` as in `SphereGenerator`.
    """

    sphere: Tensor
    faces: Tensor
    edges: Tensor

    def __init__(self) -> None:
        super().__init__()
        sphere, faces = nmr.icosphere(3)
        self.register_buffer("sphere", sphere.float(), persistent=False)
        self.register_buffer("faces", faces, persistent=False)
        self.register_buffer("edges", nmr.edge_table(faces), persistent=False)
        self.layers = nn.Sequential(nn.Linear(CODE_SIZE, 1024), nn.ReLU(), nn.Linear(1024, 2048), nn.ReLU())
        self.bias = nn.Linear(2048, sphere.shape[0] * 3)
        self.centroid = nn.Linear(2048, 3)

    def forward(self, codes: Tensor) -> Tensor:
        features = self.layers(codes)
        bias = self.bias(features).float().reshape(codes.shape[0], -1, 3)
        return deform_bounded_sphere(self.sphere, bias, 0.1 * self.centroid(features).float())


class SymmetricSphereGenerator(nn.Module):
    """Shape code [B,512] -> vertices float32 [B,642,3] that are exactly mirror-symmetric about z = 0.

    Of the 642 vertices 32 lie on z = 0 and stay there (x and y are predicted), 305 have z > 0 (x, y and z are), and 305
    are their mirror images: 64 + 915 = 979 outputs (published code of Peng et al. 2020 for Pascal3D+).
    `faces`, `edges` as in `SphereGenerator`.
    """

    sphere: Tensor
    faces: Tensor
    edges: Tensor
    middle: Tensor  # int64 [32]: vertices with z = 0
    right: Tensor  # int64 [305]: vertices with z > 0
    left: Tensor  # int64 [305]: the mirror image of each of them
    order: Tensor  # int64 [642]: where each vertex stands in [middle, right, left]

    def __init__(self) -> None:
        super().__init__()
        sphere, faces = nmr.icosphere(3)
        middle, right = (torch.nonzero(where)[:, 0] for where in (sphere[:, 2] == 0, sphere[:, 2] > 0))
        mirror = torch.tensor([1.0, 1.0, -1.0])
        mirrored = sphere[right] * mirror.to(sphere)
        left = torch.cdist(mirrored.double(), sphere.double()).argmin(dim=1)
        if not torch.equal(sphere[left], mirrored):
            raise RuntimeError("the icosphere is not symmetric about z = 0")
        buffers = {"sphere": sphere.float(), "faces": faces, "edges": nmr.edge_table(faces)}
        buffers |= {"middle": middle, "right": right, "left": left}
        buffers |= {"order": torch.cat([middle, right, left]).argsort(), "mirror": mirror}
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)
        self.layers = nn.Sequential(
            nn.Linear(CODE_SIZE, 1024),
            nn.ReLU(),
            nn.Linear(1024, 2048),
            nn.ReLU(),
            nn.Linear(2048, len(middle) * 2 + len(right) * 3),
        )

    def forward(self, codes: Tensor) -> Tensor:
        outputs = self.layers(codes).float()
        count = len(self.middle)
        middle = F.pad(outputs[:, : 2 * count].reshape(-1, count, 2), (0, 1))
        right = outputs[:, 2 * count :].reshape(-1, len(self.right), 3)
        left = right * self.mirror
        return deform_sphere(self.sphere, torch.cat([middle, right, left], dim=1)[:, self.order])


class SmallSphereGenerator(SphereGenerator):
    """The same input and output with one hidden layer of 512: for small data sets and quick experiments; no paper's."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(CODE_SIZE, 512), nn.ReLU(), nn.Linear(512, self.sphere.shape[0] * 3))


GeneratorName = Literal["sphere", "sphere-small", "symmetric", "bounded"]
GENERATORS: dict[str, type[nn.Module]] = {
    "sphere": SphereGenerator,
    "sphere-small": SmallSphereGenerator,
    "symmetric": SymmetricSphereGenerator,
    "bounded": BoundedGenerator,
}
