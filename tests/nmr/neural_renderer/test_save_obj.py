import os

import numpy as np
import pytest
import torch
from vectors import load_vector

import nmr
import nmr.neural_renderer as nr
from nmr.neural_renderer.save_obj import create_texture_image


def test_texture_image():
    v = load_vector("create_texture_image")
    image, uv = create_texture_image(torch.from_numpy(v["textures"]), int(v["texture_size_out"]))
    np.testing.assert_allclose(image, v["image"], atol=1e-5)
    np.testing.assert_allclose(uv, v["uv"], atol=1e-6)


@pytest.mark.parametrize("num_faces", [1, 2, 3, 5, 7])
def test_tiles_without_a_face_are_black(num_faces):
    image, uv = create_texture_image(torch.ones(num_faces, 1, 1, 1, 3), 4)
    tiles = image[::-1].reshape(image.shape[0] // 4, 4, -1, 4, 3).swapaxes(1, 2).reshape(-1, 16, 3)
    filled = tiles.max((1, 2)) > 0.9
    assert filled[:num_faces].all() and not filled[num_faces:].any()
    assert uv.min() >= 0 and uv.max() <= 1


def test_mesh_comes_back_exactly(tmp_path):
    vertices, faces = nmr.icosphere(1)
    vertices = vertices * torch.rand(len(vertices), 1) ** 9
    nr.save_obj(tmp_path / "a.obj", vertices.requires_grad_(), faces)
    again, again_faces = nr.load_obj(tmp_path / "a.obj", normalization=False)
    assert torch.equal(again, vertices) and torch.equal(again_faces.long(), faces)
    assert sorted(os.listdir(tmp_path)) == ["a.obj"]


@pytest.mark.parametrize("texture_size", [1, 2, 4])
def test_textures_come_back(tmp_path, texture_size):
    pytest.importorskip("PIL")
    vertices, faces = nmr.icosphere(0)
    corner_colors = torch.rand(len(faces), 3, 3)
    if texture_size == 1:
        corner_colors = corner_colors[:, :1].expand(-1, 3, -1)
    # A texture that is linear in the weights, in which any correct resampling finds the same colours.
    grid = torch.stack(torch.meshgrid(*[torch.linspace(0, 1, max(texture_size, 2))] * 3, indexing="ij"), -1)
    grid = grid / grid.sum(-1, keepdim=True).clamp_min(1e-9)
    grid[0, 0, 0] = 1 / 3
    textures = torch.einsum("ijkc,fcd->fijkd", grid, corner_colors)[:, : texture_size or 1]
    textures = textures[:, :texture_size, :texture_size, :texture_size]
    if texture_size == 1:
        textures = corner_colors[:, 0].view(-1, 1, 1, 1, 3)
    nr.save_obj(tmp_path / "mesh.obj", vertices, faces, textures)
    assert sorted(os.listdir(tmp_path)) == ["mesh.mtl", "mesh.obj", "mesh.png"]
    _, _, loaded = nr.load_obj(tmp_path / "mesh.obj", texture_size=4, load_texture=True)
    for k in range(3):
        index = tuple(3 * (torch.arange(3) == k))
        torch.testing.assert_close(loaded[(slice(None), *index)], corner_colors[:, k], rtol=0, atol=0.03)
