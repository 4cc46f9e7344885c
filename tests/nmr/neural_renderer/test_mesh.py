import pytest
import torch

import nmr
import nmr.neural_renderer as nr


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
    assert vertices.shape == (3, 12, 3) and faces.shape == (3, 20, 3) and textures.shape == (3, 20, 2, 2, 2, 3)
    textures.sum().backward()
    assert torch.all(mesh.textures.grad > 0)
