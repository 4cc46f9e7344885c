"""OpenCV's lens distortion: as OpenCV computes it, with gradients, and nothing folded into the picture beyond it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scenes import double, leaf_of, normal, uniform, value_and_gradients
from torch.autograd import gradcheck
from torch.testing import assert_close

import nmr
from nmr.cameras import from_opencv

SIZE = 64
# from corner to corner more than 90 degrees
K = [[30.0, 0.0, 32.0], [0.0, 30.0, 32.0], [0.0, 0.0, 1.0]]
TURN = 1 / math.sqrt(
    3 * 0.2
)  # where r (1 - 0.2 r^2) turns back: "barrel", and the angle of "turning fisheye"
EYE3, ZERO = torch.eye(3, dtype=torch.float64), [0.0, 0.0, 0.0]
MODELS = {
    "5": [-0.2, 0.03, 0.002, -0.001, 0.01],
    "8": [0.3, -0.1, 0.001, 0.002, 0.02, 0.5, 0.1, 0.03],
    "fisheye": [0.05, -0.02, 0.01, -0.003],
    "barrel": [-0.2, 0.0, 0.0, 0.0, 0.0],
    "pole": [0.1, 0.0, 0.0, 0.0, 0.0, -0.3, 0.0, 0.0],
    "turning fisheye": [-0.2, 0.0, 0.0, 0.0],
}


def camera(name: str, coefficients: object = None) -> nmr.Pinhole:
    given = double(MODELS[name]) if coefficients is None else coefficients
    options = dict(height=SIZE, width=SIZE, pixel_center=0.5, fisheye="fisheye" in name)
    return from_opencv(K, EYE3, ZERO, given, **options)


def distort(name: str, points: torch.Tensor) -> torch.Tensor:
    """Distorted q [N, 2] of points [N, 2] at depth 1."""
    vertices = torch.cat([points, torch.ones_like(points[:, :1])], dim=1)
    return camera(name).transform(vertices[None])[0, :, :2] * torch.tensor([SIZE, -SIZE]) / 60


@pytest.mark.parametrize("name", ["5", "8", "fisheye"])
def test_pixels_are_opencv_s(name) -> None:
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    points = np.vstack([rng.uniform(-0.8, 0.8, (300, 2)), [[0, 0], [1e-9, 1e-9]]])
    points = np.column_stack([points, np.ones(302)]) * rng.uniform(0.5, 4, (302, 1))
    project = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    wanted, _ = project(
        points[:, None], np.zeros(3), np.zeros(3), *map(np.array, (K, MODELS[name]))
    )
    x, y, _ = camera(name).transform(torch.tensor(points)[None])[0].numpy().T
    pixels = np.column_stack([(x + 1) * SIZE / 2, (1 - y) * SIZE / 2])
    assert np.allclose(pixels, wanted[:, 0], atol=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_the_image_never_turns_back(name) -> None:
    radii = torch.linspace(0, 60, 4000).double()
    for angle in np.linspace(0, 2 * math.pi, 7):
        direction = double([math.cos(angle), math.sin(angle)])
        away = (distort(name, radii[:, None] * direction) @ direction).diff()
        assert (away >= 0).all()
    inner, outer = distort(name, double([[50.0, 0.0], [51.0, 0.0]]))
    if name in ("barrel", "pole", "turning fisheye"):
        assert_close(outer - inner, double([1.0, 0.0]))  # straight on


@pytest.mark.parametrize("name", MODELS)
def test_gradients_are_finite_differences(name) -> None:
    inner, outer = uniform(1, 20, 3) - 0.5, 8 * normal(1, 20, 3)
    inner[..., 2] = outer[..., 2] = 1.0
    inner[0, 0, :2] = 0.0
    given = leaf_of(inner), leaf_of(double(MODELS[name]))
    gradcheck(lambda v, d: camera(name, d).transform(v), given)
    gradcheck(camera(name).transform, leaf_of(outer))


def undistorted(name: str) -> torch.Tensor:
    """Rays [SIZE, SIZE, 2] at depth 1 through the pixel centres, by bisection; NaN beyond the image of the lens."""
    centre = (torch.arange(SIZE).double() + 0.5 - 32) / 30
    q = torch.stack(torch.meshgrid(centre, centre, indexing="xy"), dim=-1).view(-1, 2)
    radius = q.norm(dim=1, keepdim=True)
    low, high = torch.zeros_like(radius), torch.full_like(radius, 1e4)
    for _ in range(80):
        middle = (low + high) / 2
        short = distort(name, q / radius * middle).norm(dim=1, keepdim=True) < radius
        low, high = torch.where(short, middle, low), torch.where(short, high, middle)
    reach = {"barrel": TURN, "turning fisheye": math.tan(TURN)}.get(name, math.inf)
    return torch.where(low > reach, math.nan, q / radius * low).view(SIZE, SIZE, 2)


def grid(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A square [-1, 1]^2 of 2 n^2 faces: points [., 2]."""
    steps = torch.linspace(-1, 1, n + 1).double()
    first = (torch.arange(n).view(-1, 1) * (n + 1) + torch.arange(n)).view(-1, 1)
    faces = (first + torch.tensor([[0, 1, n + 2, 0, n + 2, n + 1]])).view(-1, 3)
    return torch.cartesian_prod(steps, steps).flip(1), faces


@pytest.mark.parametrize("name", ["barrel", "turning fisheye", "8"])
def test_a_ground_under_the_eye_ends_at_the_horizon(name) -> None:
    points, faces = grid(300)
    x, z = (60 * points * points.abs()).unbind(1)  # finer under the eye
    how = dict(image_size=SIZE, anti_aliasing=False, near=0.05, far=1000.0)
    depth = nmr.render_depth(torch.stack([x, 1 + 0 * x, z], dim=1), faces, camera(name), **how)[0]
    down, seen = undistorted(name)[..., 1], undistorted(name).isfinite().all(-1)
    wanted = torch.where(down > 1 / 55, 1 / down, 1000.0)
    sky, near = seen & (down < 0), seen & (wanted < 8)
    assert sky.sum() > 1000 and (depth[sky] == 1000).all()
    assert near.sum() > 500
    assert ((depth - wanted).abs() < 0.03 * wanted)[near].float().mean() > 0.98


@pytest.mark.parametrize("name", ["barrel", "turning fisheye", "8", "fisheye"])
def test_gradients_of_pictures_are_finite_differences(name) -> None:
    """Depth and colours of a tilted wall in fine pieces, some of them cut at the near plane."""
    points, faces = grid(8)
    wall = torch.cat([1.2 * points + double([0.0137, 0.0271]), 1.0 + 0.9 * points[:, :1]], dim=1)
    colors, inputs = uniform(len(wall), 2), (wall, double(MODELS[name]))
    index = []

    def loss(vertices, coefficients):
        how = dict(image_size=16, anti_aliasing=False, near=0.3, far=9.0)
        fragments = nmr.render_fragments(vertices, faces, camera(name, coefficients), **how)
        index.append(fragments.face_index)
        return fragments.depth.sum() + fragments.interpolate(colors).square().sum()

    _, *grads = value_and_gradients(loss, *inputs)
    directions = [normal(*x.shape, seed=1) for x in inputs]
    # what lies beyond the reach of the others has no gradient to the coefficients
    if name != "fisheye":
        directions[1].zero_()
    high, low = (
        loss(*(x + step * d for x, d in zip(inputs, directions, strict=True)))
        for step in (1e-8, -1e-8)
    )
    assert torch.equal(index[1], index[2]) and (index[0] >= 0).sum() > 40
    wanted = sum((g * d).sum() for g, d in zip(grads, directions, strict=True))
    assert float((high - low) / 2e-8) == pytest.approx(float(wanted), rel=1e-4, abs=1e-4)
