import pytest
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


def test_defaults_are_half_ambient_and_half_from_above():
    up = torch.tensor([[[[0.0, 0, 0], [0, 0, 1], [1, 0, 0]], [[0.0, 0, 0], [1, 0, 0], [0, 0, 1]]]])
    out = nr.lighting(up, torch.ones(1, 2, 2, 2, 2, 3))
    assert out[0, :, 0, 0, 0].tolist() in ([[1, 1, 1], [0.5, 0.5, 0.5]], [[0.5, 0.5, 0.5], [1, 1, 1]])


def test_colours_and_direction_per_image_in_any_container():
    faces, textures = torch.rand(2, 5, 3, 3), torch.rand(2, 5, 2, 2, 2, 3)
    per_image = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    out = nr.lighting(faces, textures, 0.4, 0.7, per_image, per_image.tolist(), per_image.numpy())
    for b in range(2):
        color = tuple(per_image[b].tolist())
        one = nr.lighting(faces[b : b + 1], textures[b : b + 1], 0.4, 0.7, color, color, color)
        torch.testing.assert_close(out[b : b + 1], one)


def test_gradient_is_the_derivative():
    args = (torch.rand(2, 2, 3, 3), torch.rand(2, 2, 1, 1, 1, 3), torch.rand(3), torch.rand(2, 3), torch.rand(3))
    args = [x.double().requires_grad_() for x in args]
    assert torch.autograd.gradcheck(lambda f, t, a, d, n: nr.lighting(f, t, 0.3, 0.7, a, d, n), args)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(faces=torch.rand(1, 5, 3)), ValueError, "faces must be corners"),
        (dict(textures=torch.rand(1, 4, 2, 2, 2, 3)), ValueError, "number of faces"),
        (dict(textures=torch.rand(1, 5, 2, 3, 2, 3)), ValueError, r"\[B, F, ts, ts, ts, 3\]"),
        (dict(textures=torch.ones(1, 5, 2, 2, 2, 3, dtype=torch.int32)), TypeError, "float tensor"),
        (dict(color_ambient="white"), TypeError, "color_ambient must be numbers"),
        (dict(direction=(0, 1)), ValueError, r"direction must have shape \[3\]"),
        (dict(color_directional=torch.rand(4, 3), faces=torch.rand(2, 5, 3, 3)), ValueError, r"\[3\] or \[2, 3\]"),
    ],
)
def test_errors(change, error, message):
    with pytest.raises(error, match=message):
        nr.lighting(**(dict(faces=torch.rand(1, 5, 3, 3), textures=torch.rand(1, 5, 2, 2, 2, 3)) | change))
