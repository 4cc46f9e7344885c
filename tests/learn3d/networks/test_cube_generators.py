"""The cube's surface, and the generators that deform it."""

from __future__ import annotations

import math

import pytest
import torch

import nmr
from learn3d.networks.cube_generators import ConvCubeGenerator, CubeGenerator, LinearCubeGenerator, cube_surface


@pytest.fixture(scope="module", params=["conv", "fc", "symmetric conv", "symmetric fc"])
def generator(request) -> CubeGenerator:
    torch.manual_seed(0)
    symmetry = "z" if request.param.startswith("symmetric") else None
    if request.param.endswith("conv"):
        return ConvCubeGenerator(symmetry, channels=16)
    return LinearCubeGenerator(symmetry, channels=32)


def test_cube_is_closed_and_its_faces_look_outwards() -> None:
    points, patches, faces = cube_surface()
    edges = nmr.edge_table(faces)  # raises unless every edge has two faces
    assert (len(points), len(edges), len(faces)) == (1352, 4050, 2700)
    assert len(points) - len(edges) + len(faces) == 2  # Euler's number of a sphere
    assert patches.shape == (6, 16, 16)
    assert torch.equal(patches.unique(), torch.arange(1352))
    assert torch.equal(faces.unique(), torch.arange(1352))
    vertices = points.double() - 7.5
    outwards = (nmr.face_normals(vertices, faces) * vertices[faces].mean(1)).sum(1)
    torch.testing.assert_close(outwards, torch.full((2700,), 7.5, dtype=torch.float64))


def test_sides_share_the_vertices_at_their_edges() -> None:
    points, patches, _ = cube_surface(4)
    counts = torch.bincount(patches.flatten())
    outer = ((points == 0) | (points == 3)).sum(1)  # 1 within a side, 2 at an edge, 3 at a corner
    assert torch.equal(counts, outer)


def test_published_sizes() -> None:
    conv, linear = ConvCubeGenerator(), LinearCubeGenerator()
    weights = [tuple(p.shape) for name, p in conv.sides[3].named_parameters() if p.ndim > 1]
    assert weights == [(2048, 512), (512, 256, 3, 3), (256, 128, 3, 3), (128, 64, 3, 3), (3, 64, 3, 3)]
    assert len(conv.sides) == 6
    weights = [tuple(p.shape) for name, p in linear.layers.named_parameters() if p.ndim > 1]
    assert weights == [(4096, 512), (4096, 4096), (4056, 4096)]
    assert (conv.scale, conv.object_scale, conv.mirror) == (0.01, 0.5, None)
    assert (linear.scale, linear.object_scale, linear.mirror) == (0.1, 1.0, None)


def test_shape_is_a_sphere_where_the_bias_is_0(generator: CubeGenerator, monkeypatch) -> None:
    monkeypatch.setattr(generator, "bias", lambda codes: torch.zeros(len(codes), 1352, 3))
    vertices = generator(torch.zeros(2, 512))
    assert vertices.shape == (2, 1352, 3)
    assert vertices.dtype == torch.float32
    lengths = vertices.norm(dim=2)
    torch.testing.assert_close(lengths, torch.full_like(lengths, 0.5 * generator.object_scale))


def test_rule_of_the_vertices(generator: CubeGenerator) -> None:
    codes = torch.randn(2, 512)
    generator.eval()
    points = generator.base + generator.scale * generator.bias(codes)
    if generator.mirror is not None:
        points = points.clone()
        points[..., 2] = points[..., 2].abs()
        points = torch.stack([(points[:, i] + points[:, j]) / 2 for i, j in enumerate(generator.mirror.tolist())], 1)
        points[..., 2] *= torch.where(cube_surface()[0][:, 2] < 8, -1, 1)
    torch.testing.assert_close(generator(codes), generator.object_scale * 1.2 * torch.tanh(points))


def test_gradients_reach_codes_base_and_all_weights(generator: CubeGenerator) -> None:
    generator.zero_grad()
    codes = torch.randn(2, 512, requires_grad=True)
    (generator.train()(codes) * torch.randn(2, 1352, 3)).sum().backward()
    assert codes.grad.abs().sum() > 0
    missing = [name for name, p in generator.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert missing == []
    assert "base" in dict(generator.named_parameters())


def test_sides_are_averaged_where_they_meet() -> None:
    generator = ConvCubeGenerator(channels=8)
    values = torch.randn(6)
    for side, value in zip(generator.sides, values, strict=True):
        torch.nn.init.zeros_(side[-1].weight)
        torch.nn.init.constant_(side[-1].bias, float(value))
    bias = generator.bias(torch.randn(2, 512))
    _, patches, _ = cube_surface()
    for vertex in (0, 1, 17, 700, 1351):
        sides = [side for side in range(6) if (patches[side] == vertex).any()]
        expected = math.fsum(values[side] for side in sides) / len(sides)
        torch.testing.assert_close(bias[:, vertex], torch.full((2, 3), expected))
