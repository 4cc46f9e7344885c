"""Small scripts in the manner of neural_renderer's users: all that is changed in them is the import."""

import numpy as np
import pytest
import torch

import nmr
import nmr.neural_renderer as nr


@pytest.fixture
def mesh(tmp_path):
    vertices, faces = nmr.icosphere(2)
    nr.save_obj(str(tmp_path / "mesh.obj"), vertices * torch.tensor([0.5, 1.0, 0.5]), faces)
    return str(tmp_path / "mesh.obj")


def test_optimize_vertices(mesh):
    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            vertices, faces = nr.load_obj(mesh)
            self.vertices = torch.nn.Parameter(vertices[None, :, :])
            self.register_buffer("faces", faces[None, :, :])
            reference = np.zeros((32, 32), dtype=np.float32)
            reference[8:24, 6:26] = 1
            self.register_buffer("image_ref", torch.from_numpy(reference)[None])
            self.renderer = nr.Renderer(camera_mode="look_at", image_size=32)

        def forward(self):
            self.renderer.eye = nr.get_points_from_angles(2.732, 0, 90)
            image = self.renderer(self.vertices, self.faces, mode="silhouettes")
            return torch.sum((image - self.image_ref[None, :, :]) ** 2)

    model = Model()
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=0.01)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = model()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.15 * losses[0]


def test_find_the_camera(mesh):
    vertices, faces = (x[None] for x in nr.load_obj(mesh))
    renderer = nr.Renderer(camera_mode="look_at", image_size=32)
    renderer.eye = nr.get_points_from_angles(2.732, 30, -15)
    reference = renderer(vertices, faces, mode="silhouettes").detach()
    position = torch.nn.Parameter(torch.from_numpy(np.array([-0.3, 2.6, -2.6], dtype=np.float32)))
    renderer.eye = position
    optimizer = torch.optim.Adam(renderer.parameters(), lr=0.05)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = torch.sum((renderer(vertices, faces, mode="silhouettes") - reference) ** 2)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert min(losses) < 0.05 * losses[0]
