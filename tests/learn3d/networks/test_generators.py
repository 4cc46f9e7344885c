"""Mesh generators: mirror symmetry about any vertical plane."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

import nmr
from learn3d.networks import GENERATORS, MeshGenerator, Symmetry
from learn3d.networks.cube_generators import ConvCubeGenerator, LinearCubeGenerator

PLANES = {"x": 0.0, "z": 90.0, 0.0: 0.0, 37.5: 37.5, -90.0: -90.0}


def narrow(name: str, symmetry: Symmetry | None) -> MeshGenerator:
    torch.manual_seed(0)
    cubes = {"cube-conv": (ConvCubeGenerator, 16), "cube-fc": (LinearCubeGenerator, 32)}
    if name not in cubes:
        return GENERATORS[name](symmetry)
    kind, channels = cubes[name]
    return kind(symmetry, channels=channels)


def reflected(points: Tensor, azimuth_deg: float) -> Tensor:
    """Points mirrored at the plane through the y axis and the eye of a camera at this azimuth."""
    angle = math.radians(azimuth_deg)
    normal = torch.tensor([math.cos(angle), 0.0, math.sin(angle)])  # across the eye's (sin a, 0, -cos a)
    return points - 2 * (points @ normal)[..., None] * normal


@pytest.mark.parametrize("name", GENERATORS)
@pytest.mark.parametrize("symmetry", PLANES)
def test_shapes_are_their_own_mirror_images(name: str, symmetry: Symmetry) -> None:
    generator = narrow(name, symmetry)
    vertices = generator(3 * torch.randn(3, 512)).detach()
    mirrored = reflected(vertices, PLANES[symmetry])
    torch.testing.assert_close(vertices[:, generator.mirror], mirrored, atol=1e-6, rtol=0)
    assert (vertices[0] - vertices[1]).abs().max() > 1e-4
    assert (vertices - mirrored).abs().max() > 1e-3  # each vertex has its own partner
    if symmetry == "z":
        assert torch.equal(vertices[:, generator.mirror], vertices * torch.tensor([1.0, 1.0, -1.0]))


@pytest.mark.parametrize("symmetry", PLANES)
def test_any_vertices_can_be_made_symmetric(symmetry: Symmetry) -> None:
    generator = narrow("sphere-small", symmetry)
    vertices = torch.randn(2, 642, 3)
    symmetric = generator.symmetrized(vertices)
    mirrored = reflected(symmetric, PLANES[symmetry])
    torch.testing.assert_close(symmetric[:, generator.mirror], mirrored, atol=1e-6, rtol=0)
    torch.testing.assert_close(generator.symmetrized(symmetric), symmetric)
    own = generator(torch.randn(2, 512)).detach()
    torch.testing.assert_close(generator.symmetrized(own), own, atol=1e-6, rtol=0)
    assert narrow("sphere-small", None).symmetrized(vertices) is vertices


@pytest.mark.parametrize("name", ["sphere", "bounded"])
def test_the_camera_along_the_plane_sees_a_symmetric_silhouette(name: str) -> None:
    generator = narrow(name, 37.5)
    with torch.autocast("cpu", torch.bfloat16):
        vertices = generator(3 * torch.randn(1, 512)).detach()
    camera = nmr.LookAt.from_angles(2.732, 0.0, torch.tensor([37.5]), half_fov_deg=15.0)
    seen = nmr.render_silhouette(vertices, generator.faces, camera, image_size=64)
    assert (seen - seen.flip(2)).abs().mean() < 1e-3
    aside = nmr.LookAt.from_angles(2.732, 0.0, torch.tensor([80.0]), half_fov_deg=15.0)
    other = nmr.render_silhouette(vertices, generator.faces, aside, image_size=64)
    assert (other - other.flip(2)).abs().mean() > 5e-3


def test_the_symmetric_sphere_is_the_published_one() -> None:
    generator = GENERATORS["sphere"]("z")
    linear = [m for m in generator.modules() if isinstance(m, nn.Linear)]
    assert [(m.in_features, m.out_features) for m in linear] == [(512, 1024), (1024, 2048), (2048, 979)]
    assert not [name for name in generator.state_dict() if not name.startswith("layers")]
    vertices = generator(3 * torch.randn(4, 512))
    assert (vertices.shape, vertices.dtype) == ((4, 642, 3), torch.float32)
    assert int((vertices[0, :, 2] == 0).sum()) == 32
    # The faces are those of a mirrored mesh, too: as a set of triangles the surface is its own mirror image.
    faces, mirrored = (
        set(map(tuple, f.sort(1).values.tolist())) for f in (generator.faces, generator.mirror[generator.faces])
    )
    assert faces == mirrored


def test_every_output_of_the_symmetric_sphere_moves_its_vertices() -> None:
    """Of the 979 outputs 64 move one vertex each, 915 a vertex and its mirror image."""
    generator = GENERATORS["sphere"]("z")
    outputs = torch.zeros(1, 979, requires_grad=True)
    generator.layers = nn.Identity()
    vertices = generator(outputs)
    middle, right = (torch.nonzero(where)[:, 0] for where in (generator.sphere[:, 2] == 0, generator.sphere[:, 2] > 0))
    for vertex, coordinate, output in ((middle[3], 1, 7), (right[2], 2, 64 + 8)):
        (gradient,) = torch.autograd.grad(vertices[0, vertex, coordinate], outputs, retain_graph=True)
        assert gradient.nonzero().tolist() == [[0, output]]
        assert gradient[0, output] == 0.5
    (gradient,) = torch.autograd.grad(vertices[0, generator.mirror[right[2]], 2], outputs)
    assert gradient[0, 64 + 8] == -0.5
