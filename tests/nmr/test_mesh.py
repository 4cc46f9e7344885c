"""icosphere and edge_table."""

import pytest
import torch
from vectors import load_vector

import nmr


@pytest.mark.parametrize("n", range(5))
def test_icosphere_is_a_closed_unit_sphere(n):
    vertices, faces = nmr.icosphere(n)
    assert vertices.shape == (10 * 4**n + 2, 3) and faces.shape == (20 * 4**n, 3)
    torch.testing.assert_close(vertices.norm(dim=1), torch.ones(len(vertices)))
    assert nmr.edge_table(faces).shape == (30 * 4**n, 4)
    a, b, c = vertices[faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    assert ((normal * a).sum(1) > 0).all()  # counter-clockwise from outside
    assert len(torch.unique((vertices * 1e4).round(), dim=0)) == len(vertices)


def test_icosphere_refuses_huge_levels():
    with pytest.raises(ValueError, match=r"0\.\.7"):
        nmr.icosphere(12)


@pytest.mark.parametrize("name", ["loss_smooth_42", "loss_smooth_642"])
def test_edge_table_finds_the_published_edges(name):
    v = load_vector(name)
    ours = {(frozenset(e[:2]), frozenset(e[2:])) for e in nmr.edge_table(torch.from_numpy(v["faces"])).tolist()}
    assert ours == {(frozenset(e[:2]), frozenset(e[2:])) for e in v["params"].T.tolist()}


def test_edge_table_finds_edges_on_any_side_of_a_face():
    """The published table looks at sides 0-1 and 1-2 only, and loses an edge that is 2-0 in both its faces."""
    tetrahedron = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    rolled = torch.stack([row.roll(k) for k, row in enumerate(tetrahedron)])
    for faces in (tetrahedron, rolled, tetrahedron.int()):
        table = nmr.edge_table(faces)
        assert table.shape == (6, 4)
        assert all(sorted(row) == [0, 1, 2, 3] for row in table.tolist())


def test_edge_table_wants_a_closed_mesh():
    _, faces = nmr.icosphere(0)
    with pytest.raises(ValueError, match=r"3 of 30 have not: edge .* has 1.*fill_holes"):
        nmr.edge_table(faces[:-1])
    with pytest.raises(ValueError, match="faces of one mesh"):
        nmr.edge_table(faces[None])
    with pytest.raises(TypeError, match="integer"):
        nmr.edge_table(faces.float())
