"""look_at, look, perspective, projection and get_points_from_angles, one file: their vectors are one."""

import math

import numpy as np
import pytest
import torch
from vectors import load_vector

import nmr.neural_renderer as nr

V = load_vector("cameras")
CASES = {
    "look_at": nr.look_at,
    "look_at_1d": nr.look_at,
    "look_at_full": nr.look_at,
    "look": nr.look,
    "look_up": nr.look,
    "perspective_30": lambda vertices: nr.perspective(vertices),
    "perspective_15": lambda vertices: nr.perspective(vertices, 15),
    "perspective_14.9314": lambda vertices: nr.perspective(vertices, angle=14.9314),
    "projection": lambda **arguments: nr.projection(**arguments, orig_size=float(V["projection_orig_size"])),
}


@pytest.mark.parametrize("name", CASES)
def test_values_and_gradients(name):
    names = [key.split("_in_")[1] for key in V if key.startswith(f"{name}_in_")]
    arguments = {n: torch.from_numpy(V[f"{name}_in_{n}"]).requires_grad_() for n in names}
    out = CASES[name](**arguments)
    torch.testing.assert_close(out, torch.from_numpy(V[f"{name}_out"]), rtol=1e-5, atol=1e-5)
    out.backward(torch.from_numpy(V["upstream"]))
    for n in names:
        expected = V[f"{name}_grad_{n}"]
        error = np.linalg.norm(arguments[n].grad.numpy() - expected) / np.linalg.norm(expected)
        assert error < 1e-4, n


def test_points_from_angles():
    angles = [torch.from_numpy(V[n]) for n in ("distance", "elevation", "azimuth")]
    np.testing.assert_allclose(nr.get_points_from_angles(*angles).numpy(), V["points"], atol=2e-6)
    radians = angles[0], *(x * (math.pi / 180) for x in angles[1:])
    points = nr.get_points_from_angles(*radians, degrees=False)
    np.testing.assert_allclose(points.numpy(), V["points_radians"], atol=1e-5)
    for b, expected in enumerate(V["points_scalar"]):
        point = nr.get_points_from_angles(*(float(x[b]) for x in angles))
        assert isinstance(point, tuple) and all(isinstance(x, float) for x in point)
        np.testing.assert_allclose(point, expected, atol=1e-6)
    assert nr.get_points_from_angles(2, 0, math.pi / 2, degrees=False) == pytest.approx((2, 0, 0))
    azimuths = nr.get_points_from_angles(2.0, 0.0, torch.tensor([0.0, 90.0]))
    torch.testing.assert_close(azimuths, torch.tensor([[0.0, 0, -2], [2, 0, 0]]))
    assert nr.get_points_from_angles(*(x.numpy() for x in angles)).shape == (5, 3)


def test_an_eye_above_the_target_is_degenerate_as_published():
    v = load_vector("cameras_degenerate")
    out = nr.look_at(torch.from_numpy(v["vertices"]), torch.from_numpy(v["eye"]))
    torch.testing.assert_close(out, torch.from_numpy(v["look_at_out"]), rtol=1e-5, atol=1e-5)
    assert not nr.look(torch.rand(1, 5, 3), [0, 0, -3])[..., :2].any()


@pytest.mark.parametrize("convert", [list, tuple, np.array, torch.tensor])
@pytest.mark.parametrize("batch", [False, True])
def test_points_in_any_container(convert, batch):
    eye, at, up = [1.0, 2, -3], [0.1, 0, 0], [0, 1.0, 0.2]
    vertices = torch.rand(4, 6, 3)
    expected = nr.look_at(vertices, torch.tensor(eye), torch.tensor(at), torch.tensor(up))
    given = (convert([x] * 4 if batch else x) for x in (eye, at, up))
    torch.testing.assert_close(nr.look_at(vertices, *given), expected)
    expected = nr.look(vertices, torch.tensor(eye), torch.tensor(at), torch.tensor(up))
    given = (convert([x] * 4 if batch else x) for x in (eye, at, up))
    torch.testing.assert_close(nr.look(vertices, *given), expected)


def test_one_mesh_and_many_cameras():
    vertices = torch.rand(1, 6, 3)
    eyes = nr.get_points_from_angles(torch.full((3,), 2.0), torch.zeros(3), torch.tensor([0.0, 10, 20]))
    views = nr.perspective(nr.look_at(vertices, eyes))
    assert views.shape == (3, 6, 3)
    for b in range(3):
        torch.testing.assert_close(views[b : b + 1], nr.perspective(nr.look_at(vertices, eyes[b])))
    assert nr.perspective(vertices, torch.tensor([15.0, 30.0])).shape == (2, 6, 3)


def test_projection_takes_matrices_of_every_shape():
    vertices = torch.rand(2, 6, 3) + torch.tensor([0.0, 0, 2])
    K, R, t = np.diag([200.0, 220, 1]), np.eye(3), np.array([0.1, 0.2, 0.3])
    K[:2, 2] = 128, 120
    expected = nr.projection(vertices, K, R, t, None, 256)
    x, y, z = (vertices + torch.from_numpy(t).float()).unbind(-1)
    by_hand = torch.stack([(200 * x / z + 128) / 128 - 1, 1 - (220 * y / z + 120) / 128, z], dim=-1)
    torch.testing.assert_close(expected, by_hand)
    for shape in [(1, 3), (2, 3), (1, 1, 3), (2, 1, 3)]:
        given = np.broadcast_to(t, shape).copy()
        torch.testing.assert_close(nr.projection(vertices, K[None], R[None], given, [[0] * 5], 256), expected)
    sizes = torch.tensor([256.0, 512.0])
    torch.testing.assert_close(nr.projection(vertices, K, R, t, [0] * 5, sizes)[0], expected[0])


@pytest.mark.parametrize("dtype", [torch.float64])
def test_gradients_are_derivatives(dtype):
    def make(*shape):
        return torch.rand(*shape, dtype=dtype, requires_grad=True)

    vertices = (torch.rand(2, 3, 3, dtype=dtype) + torch.tensor([0, 0, 2.0])).requires_grad_()
    assert torch.autograd.gradcheck(nr.look_at, (vertices, make(2, 3), make(3), make(2, 3)))
    assert torch.autograd.gradcheck(nr.look, (vertices, make(3), make(2, 3), make(3)))
    assert torch.autograd.gradcheck(lambda v, a: nr.perspective(v, 20 + a), (vertices, make(2)))
    arguments = (vertices, make(2, 3, 3), make(3, 3), make(2, 1, 3), (make(5) * 0.1).detach().requires_grad_())
    assert torch.autograd.gradcheck(lambda *a: nr.projection(*a, 8.0), arguments)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda v: nr.look_at(v[0], [0, 0, 1]), ValueError, r"use vertices\[None\]"),
        (lambda v: nr.look_at(v, [0, 0]), ValueError, r"must have shape \[3\] or \[B, 3\]"),
        (lambda v: nr.look(v, [0, 0, 1], torch.rand(3, 3)), ValueError, "one batch size"),
        (lambda v: nr.look(v, [0, 0, 1], up=[1, 0]), ValueError, "up must have shape"),
        (lambda v: nr.perspective(v, 90), ValueError, "half_fov_deg"),
        (lambda v: nr.perspective(v, torch.rand(2, 2)), ValueError, "half_fov_deg"),
        (lambda v: nr.projection(v, torch.eye(4), torch.eye(3), [0] * 3, None, 8), ValueError, "K must have shape"),
        (lambda v: nr.projection(v, torch.eye(3), torch.eye(3), [0] * 4, None, 8), ValueError, "t must have shape"),
        (
            lambda v: nr.projection(v, torch.eye(3), torch.eye(3), [0] * 3, [0] * 4, 8),
            ValueError,
            r"dist_coeffs must have shape \[5\]",
        ),
        (
            lambda v: nr.projection(v, torch.eye(3).expand(3, 3, 3), torch.eye(3), [0] * 3, None, 8),
            ValueError,
            "one batch size",
        ),
        (
            lambda v: nr.get_points_from_angles([1.0, 2], [1.0, 2, 3], 0.0),
            ValueError,
            "single numbers or have one length",
        ),
    ],
)
def test_errors(call, error, message):
    with pytest.raises(error, match=message):
        call(torch.rand(2, 6, 3))


def test_gradients_reach_tensors_inside_lists():
    x = torch.tensor(0.3, requires_grad=True)
    vertices = torch.rand(1, 4, 3)
    K = [[x, 0.0, 32.0], [0.0, 30.0, 32.0], [0.0, 0.0, 1.0]]
    pose = torch.eye(3)[None], torch.tensor([[0.0, 0.0, 2.0]])
    for made in (
        nr.projection(vertices, K, *pose, None, 64),
        nr.look(vertices, [x, 0.0, -3.0], [0.0, 0.0, 1.0]),
        nr.get_points_from_angles(2.7, [x, 2.0], [1.0, 2.0]),
    ):
        (grad,) = torch.autograd.grad(made.sum(), x)
        assert grad != 0
