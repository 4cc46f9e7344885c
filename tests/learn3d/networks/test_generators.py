"""Mesh generators: the rules of their vertices, and mirror symmetry about any vertical plane."""

from __future__ import annotations

import pytest
import torch
from mirrors import reflected
from torch import nn

from learn3d.networks.generators import GENERATORS, MeshGenerator, Symmetry

PLANES = {"x": 0.0, "z": 90.0, 0.0: 0.0, 37.5: 37.5, -90.0: -90.0}


def create(name: str, symmetry: Symmetry | None) -> MeshGenerator:
    torch.manual_seed(0)
    return GENERATORS[name](symmetry)


@pytest.mark.parametrize("name", GENERATORS)
@pytest.mark.parametrize("symmetry", PLANES)
def test_shapes_are_their_own_mirror_images(name: str, symmetry: Symmetry) -> None:
    """Shapes of codes are, and any vertices can be made so."""
    generator = create(name, symmetry)
    vertices = generator(3 * torch.randn(3, 512)).detach()
    mirrored = reflected(vertices, PLANES[symmetry])
    torch.testing.assert_close(vertices[:, generator.mirror], mirrored, atol=1e-6, rtol=0)
    assert (vertices[0] - vertices[1]).abs().max() > 1e-4
    assert (vertices - mirrored).abs().max() > 1e-3  # each vertex has its own partner
    if symmetry == "z":
        assert torch.equal(vertices[:, generator.mirror], vertices * torch.tensor([1.0, 1.0, -1.0]))

    torch.testing.assert_close(generator.symmetrized(vertices), vertices, atol=1e-6, rtol=0)
    symmetric = generator.symmetrized(torch.randn_like(vertices))
    torch.testing.assert_close(
        symmetric[:, generator.mirror], reflected(symmetric, PLANES[symmetry]), atol=1e-6, rtol=0
    )
    assert create("sphere-small", None).symmetrized(vertices) is vertices


def test_the_smooth_sphere_moves_neighbours_together() -> None:
    """M keeps the mean and takes the fastest change over the sphere to a fifth; one output moves a neighbourhood."""
    generator = GENERATORS["sphere-smooth"](None)
    mixing = generator.mixing.double()
    torch.testing.assert_close(mixing.sum(1), torch.ones(642).double(), atol=1e-4, rtol=0)
    assert torch.linalg.eigvalsh(mixing)[0] == pytest.approx(0.2, abs=0.04)
    bump, neighbours = mixing[:, 0], generator.faces[(generator.faces == 0).any(1)].unique()[1:]
    assert bump[0] > 5 * bump[neighbours].max() > 0 and bump[neighbours].min() > 10 * bump[-1] > 0
    with torch.no_grad():
        generator.layers[-1].weight.zero_(), generator.layers[-1].bias.zero_()
        generator.layers[-1].bias[1] = 1.0  # y of vertex 0
        moved = generator(torch.zeros(1, 512))[0] - 0.5 * generator.sphere
    torch.testing.assert_close(moved[:, 1], 0.5 * generator.mixing[:, 0], atol=1e-6, rtol=0)
    assert not moved[:, ::2].any()


def test_the_symmetric_sphere_is_the_published_one() -> None:
    """Of the 979 outputs 64 move one vertex each, 915 a vertex and its mirror image."""
    generator = GENERATORS["sphere"]("z")
    assert not [name for name in generator.state_dict() if not name.startswith("layers")]
    # The faces are those of a mirrored mesh, too: as a set of triangles the surface is its own mirror image.
    faces, mirrored = (
        set(map(tuple, f.sort(1).values.tolist()))
        for f in (generator.faces, generator.mirror[generator.faces])
    )
    assert faces == mirrored

    outputs = torch.zeros(1, 979, requires_grad=True)
    generator.layers = nn.Identity()
    vertices = generator(outputs)
    middle, right = (
        torch.nonzero(side)[:, 0]
        for side in (generator.sphere[:, 2] == 0, generator.sphere[:, 2] > 0)
    )
    assert len(middle) == int((vertices[0, :, 2] == 0).sum()) == 32
    opposite = generator.mirror[right[2]]
    for vertex, coordinate, output, sign in (
        (middle[3], 1, 7, 1),
        (right[2], 2, 72, 1),
        (opposite, 2, 72, -1),
    ):
        (gradient,) = torch.autograd.grad(
            vertices[0, vertex, coordinate], outputs, retain_graph=True
        )
        assert gradient.nonzero().tolist() == [[0, output]]
        assert gradient[0, output] == 0.5 * sign
