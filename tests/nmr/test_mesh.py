"""Meshes: tables, normals, and lists that are packed."""

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


@pytest.mark.parametrize("name", ["loss_smooth_42", "loss_smooth_642"])
def test_edge_table_finds_the_published_edges(name):
    v = load_vector(name)
    ours = {
        (frozenset(e[:2]), frozenset(e[2:]))
        for e in nmr.edge_table(torch.from_numpy(v["faces"])).tolist()
    }
    assert ours == {(frozenset(e[:2]), frozenset(e[2:])) for e in v["params"].T.tolist()}


def test_edge_table_finds_edges_on_any_side_of_a_face():
    """The published table looks at sides 0-1 and 1-2 only, and loses an edge that is 2-0 in both its faces."""
    tetrahedron = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    rolled = torch.stack([row.roll(k) for k, row in enumerate(tetrahedron)])
    for faces in (tetrahedron, rolled, tetrahedron.int()):
        table = nmr.edge_table(faces)
        assert table.shape == (6, 4)
        assert all(sorted(row) == [0, 1, 2, 3] for row in table.tolist())


def test_edge_table_of_an_open_mesh_holds_the_inner_edges():
    """A square of two triangles has one; a sphere without one face has three fewer."""
    square = torch.tensor([[0, 1, 2], [0, 2, 3]])
    assert nmr.edge_table(square, open_mesh=True).tolist() == [[0, 2, 1, 3]]
    _, faces = nmr.icosphere(1)
    assert torch.equal(nmr.edge_table(faces, open_mesh=True), nmr.edge_table(faces))
    part, whole = (
        set(map(tuple, nmr.edge_table(f, open_mesh=True).tolist())) for f in (faces[1:], faces)
    )
    assert len(whole - part) == 3 and part < whole
    for fin in ([[0, 2, 4]], [[0, 0, 1]]):
        with pytest.raises(
            ValueError, match=r"at most two faces, but [12] of .* edge .* has .*extra faces"
        ):
            nmr.edge_table(torch.cat([square, torch.tensor(fin)]), open_mesh=True)


def test_unique_edges():
    _, faces = nmr.icosphere(2)
    assert torch.equal(nmr.unique_edges(faces), nmr.edge_table(faces)[:, :2])
    # three faces at one edge; no face at all
    fan = torch.tensor([[1, 0, 2], [1, 0, 3], [0, 1, 4], [5, 5, 0]])
    expected = [[0, 1], [0, 2], [0, 3], [0, 4], [0, 5], [1, 2], [1, 3], [1, 4]]
    assert nmr.unique_edges(fan.int()).tolist() == expected


def test_normals_of_a_sphere_point_outwards():
    vertices, faces = nmr.icosphere(3)
    centres = vertices[faces].mean(1)
    normals = nmr.face_normals(vertices, faces)
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(faces)))
    assert ((normals * centres).sum(1) > 0.99 * centres.norm(dim=1)).all()
    torch.testing.assert_close(nmr.vertex_normals(vertices, faces), vertices, rtol=0, atol=0.02)


def test_vertex_normals_weigh_by_area():
    """Two faces at vertex 0: one of area 1 in the plane z = 0, one of area 2 in the plane y = 0."""
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 2]])
    faces = torch.tensor([[0, 1, 2], [0, 3, 1]])
    normals = nmr.vertex_normals(vertices, faces)
    torch.testing.assert_close(normals[0], torch.tensor([0, 2.0, 1]) / 5**0.5)
    assert torch.equal(normals[2:], torch.tensor([[0.0, 0, 1], [0, 1, 0]]))


@pytest.mark.parametrize("function", [nmr.face_normals, nmr.vertex_normals])
def test_normals_of_batches(function):
    """One list of faces, one per mesh, integers of any width; the sign follows the winding."""
    vertices, faces = nmr.icosphere(1)
    batch = torch.stack([vertices, vertices * torch.tensor([1.0, 2, 3])])
    both = function(batch, torch.stack([faces, faces.flip(1)]).int())
    torch.testing.assert_close(both[0], function(vertices, faces))
    torch.testing.assert_close(both[1], -function(batch, faces)[1])


@pytest.mark.parametrize("function", [nmr.face_normals, nmr.vertex_normals])
def test_normals_gradcheck(function):
    vertices, faces = nmr.icosphere(0)
    vertices = (vertices * torch.tensor([1.0, 0.7, 0.5]))[None].double().requires_grad_()
    torch.autograd.gradcheck(lambda x: function(x, faces), vertices)


@pytest.mark.parametrize("function", [nmr.face_normals, nmr.vertex_normals])
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-12, 1e15])
def test_normals_of_degenerate_and_of_tiny_and_huge_faces_are_finite(function, size):
    vertices = size * torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [7, 7, 7]])
    vertices.requires_grad_()
    # right-angled, collinear, two corners equal
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 0, 3]])
    normals = function(vertices, faces)
    normals.sum().backward()
    expected = torch.tensor([0.0, 0, 1 if size > 1e-18 else 0])  # the area of 1e-60 is 0 in float32
    assert torch.equal(normals[0], expected) and not normals[-1].any()
    assert vertices.grad.isfinite().all()


SIZE = dict(image_size=24)


def sphere(subdivisions, seed, scale):
    vertices, faces = nmr.icosphere(subdivisions)
    noise = torch.rand(len(vertices), 1, generator=torch.Generator().manual_seed(seed))
    return scale * (0.6 + 0.4 * noise) * vertices, faces


MESHES = [sphere(2, 0, 0.9), sphere(1, 1, 0.6), sphere(3, 2, 0.8)]
VERTICES, FACES = [v for v, _ in MESHES], [f for _, f in MESHES]
EYES = torch.tensor([[0.0, 0.5, -2.5], [1.5, 0.0, -2.0], [-1.0, 1.0, 2.0]])


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("smooth", [False, True])
def test_lights_per_image(smooth):
    parameters = [
        uniform(3),
        uniform(3, 2),
        uniform(3, 2, 3) - 0.5,
        uniform(3, 3),
        uniform(3, 2, 3),
    ]
    parameters = [x.requires_grad_() for x in parameters]
    together = nmr.render_rgb(
        VERTICES, FACES, nmr.LookAt(EYES), lights=nmr.Lights(*parameters, smooth), **SIZE
    )
    grads = torch.autograd.grad(together.square().sum(), parameters)
    for b in range(3):
        own = [x[b].detach().requires_grad_() for x in parameters]
        alone = nmr.render_rgb(
            VERTICES[b], FACES[b], nmr.LookAt(EYES[b]), lights=nmr.Lights(*own, smooth), **SIZE
        )
        assert torch.equal(alone[0], together[b])
        for grad, own_grad in zip(
            grads, torch.autograd.grad(alone.square().sum(), own), strict=True
        ):
            torch.testing.assert_close(grad[b], own_grad, rtol=1e-4, atol=1e-4)


def test_values_of_a_batch_may_be_lists():
    vertices = torch.stack([VERTICES[0], 0.7 * VERTICES[0]])
    image = uniform(2, 4, 4, 3)
    uv = uniform(2, 50, 2)
    uv_faces = torch.stack([FACES[0] % 50, FACES[0] % 49])
    stacked, lists = (
        nmr.render_rgb(
            vertices, FACES[0], nmr.LookAt(EYES[:2]), colors=nmr.UVTexture(*values), **SIZE
        )
        for values in ((image, uv, uv_faces), (list(image), list(uv), list(uv_faces)))
    )
    assert torch.equal(stacked, lists) and stacked.any()


def test_a_list_of_one_grows_to_the_cameras_batch():
    one = nmr.render_silhouette([VERTICES[0]], [FACES[0]], nmr.LookAt(EYES), **SIZE)
    assert torch.equal(one, nmr.render_silhouette(VERTICES[0], FACES[0], nmr.LookAt(EYES), **SIZE))
