"""look_at, look, perspective, projection and get_points_from_angles, one file: their vectors are one."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close
from vectors import load_vector

import nmr.neural_renderer as nr

V = load_vector("cameras")


def test_points_from_angles():
    angles = [torch.from_numpy(V[n]) for n in ("distance", "elevation", "azimuth")]
    radians = angles[0], *(x * (math.pi / 180) for x in angles[1:])
    points = nr.get_points_from_angles
    assert_allclose(points(*angles), V["points"], atol=2e-6)
    assert_allclose(points(*radians, degrees=False), V["points_radians"], atol=1e-5)
    for *one, expected in zip(*(x.tolist() for x in angles), V["points_scalar"], strict=True):
        point = points(*one)
        assert isinstance(point, tuple) and all(isinstance(x, float) for x in point)
        assert_allclose(point, expected, atol=1e-6)
    assert points(2, 0, math.pi / 2, degrees=False) == pytest.approx((2, 0, 0))
    azimuths = points(2.0, 0.0, torch.tensor([0.0, 90.0]))
    assert_close(azimuths, torch.tensor([[0.0, 0, -2], [2, 0, 0]]))
    assert points(*(x.numpy() for x in angles)).shape == (5, 3)


def test_projection_takes_matrices_of_every_shape():
    vertices = torch.rand(2, 6, 3) + torch.tensor([0.0, 0, 2])
    K, R, t = (
        np.array([[200.0, 0, 128], [0, 220, 120], [0, 0, 1]]),
        np.eye(3),
        np.array([0.1, 0.2, 0.3]),
    )
    expected = nr.projection(vertices, K, R, t, None, 256)
    for shape in [(1, 3), (2, 3), (1, 1, 3), (2, 1, 3)]:
        given = K[None], R[None], np.broadcast_to(t, shape).copy()
        assert_close(nr.projection(vertices, *given, [[0] * 5], 256), expected)
    sizes = torch.tensor([256.0, 512.0])
    assert_close(nr.projection(vertices, K, R, t, [0] * 5, sizes)[0], expected[0])
