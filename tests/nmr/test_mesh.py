"""Meshes: tables, normals, and lists that are packed."""

import functools

import pytest
import torch
from scenes import bumpy_sphere, double, leaf_of, normal, uniform, value_and_gradients
from torch.autograd import gradcheck, gradgradcheck
from torch.testing import assert_close
from vectors import load_vector

import nmr


@pytest.mark.parametrize("n", range(5))
def test_icosphere_is_a_closed_unit_sphere(n):
    vertices, faces = nmr.icosphere(n)
    assert vertices.shape == (10 * 4**n + 2, 3) and faces.shape == (20 * 4**n, 3)
    assert_close(vertices.norm(dim=1), torch.ones(len(vertices)))
    assert nmr.edge_table(faces).shape == (30 * 4**n, 4)
    a, b, c = vertices[faces].unbind(1)
    assert (torch.linalg.det(torch.stack([a, b, c], 1)) > 0).all()  # counter-clockwise from outside
    assert len(torch.unique((vertices * 1e4).round(), dim=0)) == len(vertices)


@pytest.mark.parametrize("name", ["loss_smooth_42", "loss_smooth_642"])
def test_edge_table_finds_the_published_edges(name):
    v = load_vector(name)
    ours, published = (
        {(frozenset(row[:2]), frozenset(row[2:])) for row in table.tolist()}
        for table in (nmr.edge_table(torch.from_numpy(v["faces"])), v["params"].T)
    )
    assert ours == published


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
    whole = nmr.edge_table(faces)
    assert torch.equal(nmr.edge_table(faces, open_mesh=True), whole)
    part, whole = (
        set(map(tuple, table.tolist()))
        for table in (nmr.edge_table(faces[1:], open_mesh=True), whole)
    )
    assert len(whole - part) == 3 and part < whole
    for fin in ([0, 2, 4], [0, 0, 1]):
        with pytest.raises(
            ValueError, match=r"at most two faces, but [12] of .* edge .* has .*extra faces"
        ):
            nmr.edge_table(torch.cat([square, torch.tensor([fin])]), open_mesh=True)


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
    assert_close(normals.norm(dim=1), torch.ones(len(faces)))
    assert ((normals * centres).sum(1) > 0.99 * centres.norm(dim=1)).all()
    assert_close(nmr.vertex_normals(vertices, faces), vertices, rtol=0, atol=0.02)


def test_vertex_normals_weigh_by_area():
    """Two faces at vertex 0: one of area 1 in the plane z = 0, one of area 2 in the plane y = 0."""
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 2]])
    faces = torch.tensor([[0, 1, 2], [0, 3, 1]])
    normals = nmr.vertex_normals(vertices, faces)
    assert_close(normals[0], torch.tensor([0, 2.0, 1]) / 5**0.5)
    assert torch.equal(normals[2:], torch.tensor([[0.0, 0, 1], [0, 1, 0]]))


@pytest.mark.parametrize("function", [nmr.face_normals, nmr.vertex_normals])
def test_normals_of_batches(function):
    """One list of faces, one per mesh, integers of any width; the sign follows the winding."""
    vertices, faces = nmr.icosphere(1)
    batch = torch.stack([vertices, vertices * torch.tensor([1.0, 2, 3])])
    both = function(batch, torch.stack([faces, faces.flip(1)]).int())
    assert_close(both[0], function(vertices, faces))
    assert_close(both[1], -function(batch, faces)[1])


@pytest.mark.parametrize("function", [nmr.face_normals, nmr.vertex_normals])
def test_normals_have_first_and_second_derivatives(function):
    vertices, faces = nmr.icosphere(0)
    vertices = leaf_of(vertices * double([[[1.0, 0.7, 0.5]]]))
    gradcheck(lambda x: function(x, faces), vertices)
    gradgradcheck(lambda x: function(x, faces[:3]), vertices)


def test_second_derivatives_of_packed_normals(smooth):
    """The operator's: of two meshes, each alone."""
    vertices, faces = nmr.icosphere(0)
    vertices = torch.cat([vertices, vertices[:4]]) * double([1.0, 0.7, 0.5])
    faces, starts = torch.cat([faces[:3], faces[:1] % 4]), torch.tensor([[0, 0], [12, 3], [16, 4]])
    gradgradcheck(lambda x: nmr.ops.normals(x, faces, starts, smooth), leaf_of(vertices))


def test_faces_that_name_a_vertex_twice_have_no_normal(dtype):
    vertices = normal(30, 3, dtype=dtype)
    first = torch.arange(30)
    faces = torch.cat([torch.stack([first, first.roll(1), first], 1).roll(k, 1) for k in range(3)])
    assert not nmr.face_normals(vertices, faces).any()


@pytest.mark.parametrize("function", [nmr.face_normals, nmr.vertex_normals])
@pytest.mark.parametrize(
    "size, dtype",
    [*((x, torch.float32) for x in (0.0, 1e-30, 1e-17, 1e15)), (1e-140, torch.float64)],
)
def test_normals_of_degenerate_and_of_tiny_and_huge_faces_are_finite(function, size, dtype):
    vertices = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [7, 7, 7]]
    vertices = size * torch.tensor(vertices, dtype=dtype)
    # right-angled, collinear, two corners equal
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 0, 3]])
    normals, grad = value_and_gradients(lambda x: function(x, faces), vertices)
    drawn = size > 0 and size != 1e-30  # the area of 1e-60 is 0 in float32
    expected = torch.tensor([0, 0, drawn]).to(dtype)
    assert torch.equal(normals[0], expected) and not normals[-1].any()
    assert grad.isfinite().all()


SIZE = dict(image_size=24)


MESHES = [bumpy_sphere(n, seed, dtype=torch.float32) for n, seed in ((2, 0), (1, 1), (3, 2))]
VERTICES, FACES = [v for v, _ in MESHES], [f for _, f in MESHES]
EYES = torch.tensor([[0.0, 0.5, -2.5], [1.5, 0.0, -2.0], [-1.0, 1.0, 2.0]])


def test_lights_per_image(smooth):
    shapes = (3,), (3, 2), (3, 2, 3), (3, 3), (3, 2, 3)
    parameters = [uniform(*x, seed=k, dtype=torch.float32) for k, x in enumerate(shapes)]
    parameters[2] -= 0.5  # directions

    def lit(vertices, faces, eyes, *parameters):
        lights = nmr.Lights(*parameters, smooth)
        return nmr.render_rgb(vertices, faces, nmr.LookAt(eyes), lights=lights, **SIZE)

    upstream = normal(3, 24, 24, 3).float()
    together, *grads = value_and_gradients(
        functools.partial(lit, VERTICES, FACES, EYES), *parameters, upstream=upstream
    )
    for b, mesh in enumerate(zip(VERTICES, FACES, EYES, strict=True)):
        own = [x[b] for x in parameters]
        alone, *own_grads = value_and_gradients(
            functools.partial(lit, *mesh), *own, upstream=upstream[b]
        )
        assert torch.equal(alone[0], together[b])
        assert_close([x[b] for x in grads], own_grads, rtol=1e-4, atol=1e-4)


def test_a_list_of_one_grows_to_the_cameras_batch():
    one, plain = (
        nmr.render_silhouette(*mesh, nmr.LookAt(EYES), **SIZE)
        for mesh in ((VERTICES[:1], FACES[:1]), (VERTICES[0], FACES[0]))
    )
    assert torch.equal(one, plain)
