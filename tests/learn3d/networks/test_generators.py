"""The mirror-symmetric generator."""

from __future__ import annotations

import torch
from torch import nn

from learn3d.networks import GENERATORS


def test_symmetric_meshes_are_exactly_symmetric() -> None:
    torch.manual_seed(0)
    generator = GENERATORS["symmetric"]()
    linear = [m for m in generator.modules() if isinstance(m, nn.Linear)]
    assert [(m.in_features, m.out_features) for m in linear] == [(512, 1024), (1024, 2048), (2048, 979)]
    assert [len(x) for x in (generator.middle, generator.right, generator.left)] == [32, 305, 305]
    assert not [name for name in generator.state_dict() if not name.startswith("layers")]
    vertices = generator(3 * torch.randn(4, 512))
    assert vertices.shape == (4, 642, 3) and vertices.dtype == torch.float32
    mirror = torch.tensor([1.0, 1.0, -1.0])
    assert torch.equal(vertices[:, generator.left], vertices[:, generator.right] * mirror)
    assert (vertices[:, generator.middle, 2] == 0).all()
    assert (vertices[0] != vertices[1]).any() and (vertices[:, generator.right, 2] != 0).all()
    # The faces are those of a mirrored mesh, too: as a set of triangles the surface is its own mirror image.
    partner = torch.arange(642)
    partner[generator.right], partner[generator.left] = generator.left, generator.right
    faces, mirrored = (set(map(tuple, f.sort(1).values.tolist())) for f in (generator.faces, partner[generator.faces]))
    assert faces == mirrored and len(faces) == 1280


def test_symmetric_meshes_start_from_the_same_sphere() -> None:
    symmetric, free = GENERATORS["symmetric"](), GENERATORS["sphere"]()
    for generator in (symmetric, free):
        nn.init.zeros_(generator.layers[-1].weight)
        nn.init.zeros_(generator.layers[-1].bias)
    code = torch.zeros(1, 512)
    assert torch.equal(symmetric(code), free(code)) and torch.equal(symmetric.faces, free.faces)
    assert symmetric(code).norm(dim=2).sub(0.5).abs().max() < 1e-6


def test_every_output_moves_its_vertices() -> None:
    """Of the 979 outputs 64 move one vertex each, 915 a vertex and its mirror image."""
    generator = GENERATORS["symmetric"]()
    outputs = torch.zeros(1, 979, requires_grad=True)
    generator.layers = nn.Identity()
    vertices = generator(outputs)
    for vertex, coordinate, output in ((generator.middle[3], 1, 7), (generator.right[2], 2, 64 + 8)):
        (gradient,) = torch.autograd.grad(vertices[0, vertex, coordinate], outputs, retain_graph=True)
        assert gradient.nonzero().tolist() == [[0, output]] and gradient[0, output] == 0.5
    (gradient,) = torch.autograd.grad(vertices[0, generator.left[2], 2], outputs)
    assert gradient[0, 64 + 8] == -0.5
