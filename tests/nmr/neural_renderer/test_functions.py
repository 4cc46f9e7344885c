"""Small functions of neural_renderer: lighting, meshes, corners of faces."""

import numpy as np
import pytest
import torch
from scenes import value_and_gradients
from torch.testing import assert_close
from vectors import load_vector, tensors_of

import nmr
import nmr.neural_renderer as nr


def test_values_and_gradients():
    v = load_vector("lighting")
    names = "intensity_ambient intensity_directional color_ambient color_directional direction"
    settings = {name: v[name].tolist() for name in names.split()}
    published = tensors_of(v, "")
    out, *grads = value_and_gradients(
        lambda faces, textures: nr.lighting(faces, textures, **settings),
        published["faces"],
        published["textures"],
        upstream=published["upstream"],
    )
    assert_close(out, published["out"], rtol=0, atol=1e-6)
    assert_close(grads[0], published["grad_faces"], rtol=1e-4, atol=1e-5)
    assert_close(grads[1], published["grad_textures"], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("batch", [2, 3])
def test_colours_and_direction_per_image_in_any_container(batch):
    """Three images of one face, too: the published function takes the cross product along the batch."""
    faces, textures = torch.rand(batch, 1, 3, 3), torch.rand(batch, 1, 2, 2, 2, 3)
    colors = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]])[:batch]
    out = nr.lighting(faces, textures, 0.4, 0.7, colors, colors.tolist(), colors.numpy())
    for b in range(batch):
        given = [tuple(colors[b].tolist())] * 3
        one = nr.lighting(faces[b : b + 1], textures[b : b + 1], 0.4, 0.7, *given)
        assert_close(out[b : b + 1], one)


def test_attributes():
    sphere, textures = nmr.icosphere(1), torch.rand(80, 3, 3, 3, 3)
    mesh, given = nr.Mesh(*sphere), nr.Mesh(*sphere, textures)
    assert mesh.num_vertices == 42 and mesh.num_faces == 80 and mesh.texture_size == 4
    assert isinstance(mesh.textures, torch.nn.Parameter) and mesh.textures.shape == (80, 4, 4, 4, 3)
    assert 0.04 < mesh.textures.std() < 0.06
    assert given.textures is textures and given.texture_size == 3


def test_fromobj(tmp_path):
    vertices, faces = nmr.icosphere(0)
    nr.save_obj(tmp_path / "a.obj", vertices, faces)
    mesh = nr.Mesh.fromobj(tmp_path / "a.obj", normalization=False, texture_size=2)
    assert torch.equal(mesh.vertices, vertices) and mesh.textures.shape == (20, 2, 2, 2, 3)
    pytest.importorskip("PIL")
    nr.save_obj(tmp_path / "a.obj", vertices, faces, torch.full((20, 2, 2, 2, 3), 0.2))
    mesh = nr.Mesh.fromobj(tmp_path / "a.obj", load_texture=True)
    assert_close(mesh.textures, torch.full((20, 4, 4, 4, 3), 0.2))


def test_batches_share_memory_and_gradients():
    mesh = nr.Mesh(*nmr.icosphere(0), texture_size=2)
    batch = mesh.get_batch(3)
    assert [tuple(x.shape) for x in batch] == [(3, 12, 3), (3, 20, 3), (3, 20, 2, 2, 2, 3)]
    batch[2].sum().backward()
    assert torch.all(mesh.textures.grad > 0)


@pytest.mark.parametrize("kind", [torch.int32, torch.int64, torch.float32, "array"])
def test_corners(kind):
    vertices, faces = torch.rand(2, 7, 3), torch.randint(0, 7, (2, 5, 3))
    given = faces.numpy().astype(np.int32) if kind == "array" else faces.to(kind)
    upstream = torch.ones(2, 5, 3, 3)
    corners, grad = value_and_gradients(
        lambda x: nr.vertices_to_faces(x, given), vertices, upstream=upstream
    )
    assert torch.equal(corners, torch.stack([vertices[b, faces[b]] for b in range(2)]))
    for one in (given[:1], given[0]):
        assert torch.equal(nr.vertices_to_faces(vertices, one), vertices[:, faces[0]])
    assert torch.equal(grad[..., 0].sum(1), torch.tensor([15.0, 15.0]))
