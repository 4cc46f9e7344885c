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
    "projection": lambda **arguments: nr.projection(
        **arguments, orig_size=float(V["projection_orig_size"])
    ),
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
        torch.testing.assert_close(
            nr.projection(vertices, K[None], R[None], given, [[0] * 5], 256), expected
        )
    sizes = torch.tensor([256.0, 512.0])
    torch.testing.assert_close(nr.projection(vertices, K, R, t, [0] * 5, sizes)[0], expected[0])
