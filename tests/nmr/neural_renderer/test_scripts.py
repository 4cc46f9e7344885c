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


def test_draw_from_many_viewpoints(mesh):
    vertices, faces = nr.load_obj(mesh)
    vertices, faces = vertices[None, :, :], faces[None, :, :]
    textures = torch.ones(1, faces.shape[1], 2, 2, 2, 3, dtype=torch.float32)
    renderer = nr.Renderer(camera_mode="look_at", image_size=32)
    coverage = []
    for azimuth in range(0, 360, 120):
        renderer.eye = nr.get_points_from_angles(2.732, 0, azimuth)
        images, _, _ = renderer(vertices, faces, textures)
        image = images.detach().cpu().numpy()[0].transpose((1, 2, 0))
        coverage.append((image > 0).any(-1).mean())
        assert image.shape == (32, 32, 3) and 0 <= image.min() and image.max() <= 1
    assert 0.05 < min(coverage) and max(coverage) - min(coverage) < 0.02


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


def test_optimize_textures(mesh):
    class Model(torch.nn.Module):
        def __init__(self):
            super().__init__()
            vertices, faces = nr.load_obj(mesh)
            self.register_buffer("vertices", vertices[None, :, :])
            self.register_buffer("faces", faces[None, :, :])
            self.textures = torch.nn.Parameter(torch.zeros(1, self.faces.shape[1], 4, 4, 4, 3))
            self.renderer = nr.Renderer(camera_mode="look_at", image_size=32)
            self.renderer.perspective = False
            self.renderer.light_intensity_directional = 0.0
            self.renderer.light_intensity_ambient = 1.0

        def forward(self, azimuth):
            self.renderer.eye = nr.get_points_from_angles(2.732, 0, azimuth)
            image, _, alpha = self.renderer(self.vertices, self.faces, torch.tanh(self.textures))
            target = torch.tensor([0.9, 0.3, 0.1])[None, :, None, None] * alpha[:, None].detach()
            return torch.sum((image - target) ** 2)

    model = Model()
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1, betas=(0.5, 0.999))
    losses = []
    for step in range(60):
        optimizer.zero_grad()
        loss = model(90 * (step % 4))
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.02 * losses[0]


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


def test_weak_perspective_in_the_manner_of_chainer():
    """Its own projection before, all settings as attributes, faces as int32, the mesh copied over the batch."""
    vertices, faces = nmr.icosphere(1)
    renderer = nr.Renderer()
    renderer.image_size = 24
    renderer.anti_aliasing = False
    renderer.perspective = False
    renderer.eye = np.array([0, 0, -2.732])
    renderer.light_intensity_ambient = 0.8
    renderer.background_color = [1, 1, 1]
    scale, shift = torch.tensor([[[0.4]], [[0.6]]]), torch.tensor([[[0.1, -0.2, 0.0]], [[0.0, 0.0, 0.0]]])
    moved = (vertices[None].repeat(2, 1, 1) * scale + shift).requires_grad_()
    faces = faces[None].repeat(2, 1, 1).int()
    silhouettes = renderer.render_silhouettes(moved, faces)
    textures = torch.rand(2, faces.shape[1], 6, 6, 6, 3)
    image = renderer.render_rgb(moved, faces, textures)
    assert torch.all(image.permute(0, 2, 3, 1)[silhouettes == 0] == 1)
    (silhouettes.mean() + image.mean()).backward()
    assert moved.grad.any()
    area = silhouettes.mean((1, 2)) * 4 / (torch.pi * scale.flatten() ** 2)
    assert torch.all((area > 0.85) & (area < 1.05))
