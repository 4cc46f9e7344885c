import torch
from vectors import load_vector

import nmr.neural_renderer as nr


def settings_of(v):
    names = ("intensity_ambient", "intensity_directional", "color_ambient", "color_directional", "direction")
    return {name: v[name].tolist() for name in names}


def test_values_and_gradients():
    v = load_vector("lighting")
    faces, textures = (torch.from_numpy(v[name]).requires_grad_() for name in ("faces", "textures"))
    out = nr.lighting(faces, textures, **settings_of(v))
    torch.testing.assert_close(out, torch.from_numpy(v["out"]), rtol=0, atol=1e-6)
    out.backward(torch.from_numpy(v["upstream"]))
    torch.testing.assert_close(faces.grad, torch.from_numpy(v["grad_faces"]), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(textures.grad, torch.from_numpy(v["grad_textures"]), rtol=1e-5, atol=1e-6)


def test_colours_and_direction_per_image_in_any_container():
    faces, textures = torch.rand(2, 5, 3, 3), torch.rand(2, 5, 2, 2, 2, 3)
    per_image = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    out = nr.lighting(faces, textures, 0.4, 0.7, per_image, per_image.tolist(), per_image.numpy())
    for b in range(2):
        color = tuple(per_image[b].tolist())
        one = nr.lighting(faces[b : b + 1], textures[b : b + 1], 0.4, 0.7, color, color, color)
        torch.testing.assert_close(out[b : b + 1], one)
