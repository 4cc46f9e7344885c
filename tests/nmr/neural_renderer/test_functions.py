"""Small functions of neural_renderer: lighting, meshes, corners of faces."""

import numpy as np
import pytest
import torch
from vectors import load_vector

import nmr
import nmr.neural_renderer as nr


def settings_of(v):
    names = (
        "intensity_ambient",
        "intensity_directional",
        "color_ambient",
        "color_directional",
        "direction",
    )
    return {name: v[name].tolist() for name in names}


def test_values_and_gradients():
    v = load_vector("lighting")
    faces, textures = (torch.from_numpy(v[name]).requires_grad_() for name in ("faces", "textures"))
    out = nr.lighting(faces, textures, **settings_of(v))
    torch.testing.assert_close(out, torch.from_numpy(v["out"]), rtol=0, atol=1e-6)
    out.backward(torch.from_numpy(v["upstream"]))
    torch.testing.assert_close(faces.grad, torch.from_numpy(v["grad_faces"]), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        textures.grad, torch.from_numpy(v["grad_textures"]), rtol=1e-5, atol=1e-6
    )


def test_colours_and_direction_per_image_in_any_container():
    faces, textures = torch.rand(2, 5, 3, 3), torch.rand(2, 5, 2, 2, 2, 3)
    per_image = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    out = nr.lighting(faces, textures, 0.4, 0.7, per_image, per_image.tolist(), per_image.numpy())
    for b in range(2):
        color = tuple(per_image[b].tolist())
        one = nr.lighting(faces[b : b + 1], textures[b : b + 1], 0.4, 0.7, color, color, color)
        torch.testing.assert_close(out[b : b + 1], one)


def test_attributes():
    vertices, faces = nmr.icosphere(1)
    mesh = nr.Mesh(vertices, faces)
    assert mesh.num_vertices == 42 and mesh.num_faces == 80 and mesh.texture_size == 4
    assert isinstance(mesh.textures, torch.nn.Parameter) and mesh.textures.shape == (80, 4, 4, 4, 3)
    assert 0.04 < mesh.textures.std() < 0.06
    textures = torch.rand(80, 3, 3, 3, 3)
    mesh = nr.Mesh(vertices, faces, textures)
    assert mesh.textures is textures and mesh.texture_size == 3


def test_fromobj(tmp_path):
    vertices, faces = nmr.icosphere(0)
    nr.save_obj(tmp_path / "a.obj", vertices, faces)
    mesh = nr.Mesh.fromobj(tmp_path / "a.obj", normalization=False, texture_size=2)
    assert torch.equal(mesh.vertices, vertices) and mesh.textures.shape == (20, 2, 2, 2, 3)
    pytest.importorskip("PIL")
    nr.save_obj(tmp_path / "a.obj", vertices, faces, torch.full((20, 2, 2, 2, 3), 0.2))
    mesh = nr.Mesh.fromobj(tmp_path / "a.obj", load_texture=True)
    torch.testing.assert_close(mesh.textures, torch.full((20, 4, 4, 4, 3), 0.2))


def test_batches_share_memory_and_gradients():
    mesh = nr.Mesh(*nmr.icosphere(0), texture_size=2)
    vertices, faces, textures = mesh.get_batch(3)
    assert (
        vertices.shape == (3, 12, 3)
        and faces.shape == (3, 20, 3)
        and textures.shape == (3, 20, 2, 2, 2, 3)
    )
    textures.sum().backward()
    assert torch.all(mesh.textures.grad > 0)


@pytest.mark.parametrize("kind", [torch.int32, torch.int64, torch.float32, "array"])
def test_corners(kind):
    vertices = torch.rand(2, 7, 3, requires_grad=True)
    faces = torch.randint(0, 7, (2, 5, 3))
    given = faces.numpy().astype(np.int32) if kind == "array" else faces.to(kind)
    corners = nr.vertices_to_faces(vertices, given)
    assert torch.equal(corners, torch.stack([vertices[b, faces[b]] for b in range(2)]))
    assert torch.equal(nr.vertices_to_faces(vertices, given[:1]), vertices[:, faces[0]])
    assert torch.equal(nr.vertices_to_faces(vertices, given[0]), vertices[:, faces[0]])
    corners.sum().backward()
    assert torch.equal(vertices.grad[..., 0].sum(1), torch.tensor([15.0, 15.0]))
