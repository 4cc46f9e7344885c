"""OpenCV's lens distortion: as OpenCV computes it, with gradients, and nothing folded into the picture beyond it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import nmr
from nmr.cameras import from_opencv

SIZE = 64
# from corner to corner more than 90 degrees
K = [
    [30.0, 0.0, 32.0],
    [0.0, 30.0, 32.0],
    [0.0, 0.0, 1.0],
]
EYE3, ZERO = torch.eye(3, dtype=torch.float64), [0.0, 0.0, 0.0]
MODELS = {
    "5": [-0.2, 0.03, 0.002, -0.001, 0.01],
    "8": [0.3, -0.1, 0.001, 0.002, 0.02, 0.5, 0.1, 0.03],
    "fisheye": [0.05, -0.02, 0.01, -0.003],
    "barrel": [-0.2, 0.0, 0.0, 0.0, 0.0],
    "pole": [0.1, 0.0, 0.0, 0.0, 0.0, -0.3, 0.0, 0.0],
    "turning fisheye": [-0.2, 0.0, 0.0, 0.0],
}


def camera(name: str, coefficients: object = None, **how) -> nmr.Pinhole:
    given = (
        torch.tensor(MODELS[name], dtype=torch.float64) if coefficients is None else coefficients
    )
    options = {"height": SIZE, "width": SIZE, "pixel_center": 0.5, "fisheye": "fisheye" in name}
    return from_opencv(K, EYE3, ZERO, given, **options | how)


def plane(points: torch.Tensor) -> torch.Tensor:
    """Distorted q [N, 2] of points [N, 2] at depth 1, from the camera's renderer coordinates."""
    return points * torch.tensor([SIZE, -SIZE]) / 60 if points.ndim else points


def distort(name: str, points: torch.Tensor) -> torch.Tensor:
    vertices = torch.cat([points, torch.ones(len(points), 1, dtype=points.dtype)], dim=1)
    return plane(camera(name).transform(vertices[None])[0, :, :2])


@pytest.mark.parametrize("name", ["5", "8", "fisheye"])
def test_pixels_are_opencv_s(name) -> None:
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [rng.uniform(-0.8, 0.8, (300, 2)), np.zeros((1, 2)), np.full((1, 2), 1e-9)]
    )
    points = np.concatenate([points, np.ones((302, 1))], axis=1) * rng.uniform(0.5, 4, (302, 1))
    project = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    wanted, _ = project(
        points[:, None], np.zeros(3), np.zeros(3), np.array(K), np.array(MODELS[name])
    )
    found = camera(name).transform(torch.tensor(points)[None])[0, :, :2].numpy()
    pixels = np.stack([(found[:, 0] + 1) * SIZE / 2, (1 - found[:, 1]) * SIZE / 2], axis=1)
    assert np.allclose(pixels, wanted[:, 0], atol=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_the_image_never_turns_back(name) -> None:
    radii = torch.linspace(0, 60, 4000, dtype=torch.float64)
    for angle in np.linspace(0, 2 * math.pi, 7):
        direction = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
        away = (distort(name, radii[:, None] * direction) @ direction).diff()
        assert (away >= 0).all()
    beyond = distort(name, torch.tensor([[50.0, 0.0], [51.0, 0.0]], dtype=torch.float64))
    if name in ("barrel", "pole", "turning fisheye"):
        assert torch.allclose(
            beyond[1] - beyond[0], torch.tensor([1.0, 0.0], dtype=torch.float64)
        ), "straight on"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_reach_is_where_the_formula_turns(dtype) -> None:
    turn = 1 / math.sqrt(3 * 0.2)  # of r (1 - 0.2 r^2)
    radii = torch.tensor([0.5 * turn, 0.999 * turn, 1.5 * turn], dtype=dtype)
    vertices = torch.stack([radii, 0 * radii, 1 + 0 * radii], dim=1)
    found = plane(camera("barrel").transform(vertices[None])[0, :, :2])[:, 0]
    wanted = radii * (1 - 0.2 * radii**2)
    wanted[2] = turn * (1 - 0.2 * turn**2) + 0.5 * turn
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_gradients_are_finite_differences(name) -> None:
    torch.manual_seed(0)
    inner = torch.rand(1, 20, 3, dtype=torch.float64) - 0.5
    outer = 8 * torch.randn(1, 20, 3, dtype=torch.float64)
    inner[..., 2], outer[..., 2] = 1.0, 1.0
    inner[0, 0, :2] = 0.0
    coefficients = torch.tensor(MODELS[name], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda v, d: camera(name, d).transform(v), (inner.requires_grad_(), coefficients)
    )
    assert torch.autograd.gradcheck(lambda v: camera(name).transform(v), outer.requires_grad_())


def undistorted(name: str) -> torch.Tensor:
    """Rays [SIZE, SIZE, 2] at depth 1 through the pixel centres, by bisection; NaN beyond the image of the lens."""
    centre = (torch.arange(SIZE, dtype=torch.float64) + 0.5 - 32) / 30
    q = torch.stack(torch.meshgrid(centre, centre, indexing="xy"), dim=-1).reshape(-1, 2)
    radius = q.norm(dim=1, keepdim=True)
    low, high = torch.zeros_like(radius), torch.full_like(radius, 1e4)
    for _ in range(80):
        middle = (low + high) / 2
        short = distort(name, q / radius * middle).norm(dim=1, keepdim=True) < radius
        low, high = torch.where(short, middle, low), torch.where(short, high, middle)
    rays = q / radius * low
    # r of "barrel" and the angle of "turning fisheye" at which they turn back
    turn = 1 / math.sqrt(3 * 0.2)
    reach = {"barrel": turn, "turning fisheye": math.tan(turn)}.get(name, math.inf)
    rays[low[:, 0] > reach] = float("nan")
    return rays.reshape(SIZE, SIZE, 2)


def grid(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A square [-1, 1]^2 of 2 n^2 faces: points [., 2]."""
    steps = torch.linspace(-1, 1, n + 1, dtype=torch.float64)
    x, y = torch.meshgrid(steps, steps, indexing="xy")
    first = (torch.arange(n).view(-1, 1) * (n + 1) + torch.arange(n)).view(-1, 1)
    faces = (first + torch.tensor([[0, 1, n + 2, 0, n + 2, n + 1]])).view(-1, 3)
    return torch.stack([x.flatten(), y.flatten()], dim=1), faces


@pytest.mark.parametrize("name", ["barrel", "turning fisheye", "8"])
def test_a_ground_under_the_eye_ends_at_the_horizon(name) -> None:
    points, faces = grid(300)
    points = 60 * points * points.abs()  # finer under the eye
    ground = torch.stack(
        [points[:, 0], torch.ones(len(points), dtype=torch.float64), points[:, 1]], dim=1
    )
    depth = nmr.render_depth(
        ground, faces, camera(name), image_size=SIZE, anti_aliasing=False, near=0.05, far=1000.0
    )
    rays = undistorted(name)
    wanted = torch.where(
        rays[..., 1] > 1 / 55, 1 / rays[..., 1], torch.full_like(rays[..., 1], 1000.0)
    )[None]
    sky = torch.isfinite(rays).all(-1)[None] & (rays[None, ..., 1] < 0)
    assert sky.sum() > 1000 and (depth[sky] == 1000).all()
    seen = torch.isfinite(rays).all(-1)[None] & (wanted < 8)
    assert seen.sum() > 500
    assert ((depth - wanted).abs()[seen] < 0.03 * wanted[seen]).float().mean() > 0.98


@pytest.mark.parametrize("name", ["barrel", "turning fisheye", "8", "fisheye"])
def test_gradients_of_pictures_are_finite_differences(name) -> None:
    """Depth and colours of a tilted wall in fine pieces, some of them cut at the near plane."""
    points, faces = grid(8)
    wall = torch.cat(
        [1.2 * points + torch.tensor([0.0137, 0.0271]), 1.0 + 0.9 * points[:, :1]], dim=1
    )
    colors = torch.rand(
        len(wall), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    lens = torch.tensor(MODELS[name], dtype=torch.float64)

    def loss(vertices, coefficients):
        how = {"image_size": 16, "anti_aliasing": False, "near": 0.3, "far": 9.0}
        fragments = nmr.render_fragments(vertices, faces, camera(name, coefficients), **how)
        return fragments.face_index, fragments.depth.sum() + fragments.interpolate(
            colors
        ).square().sum()

    leaves = wall.clone().requires_grad_(), lens.clone().requires_grad_()
    index, value = loss(*leaves)
    grads = torch.autograd.grad(value, leaves)
    directions = [
        torch.randn(x.shape, dtype=x.dtype, generator=torch.Generator().manual_seed(1))
        for x in leaves
    ]
    # what lies beyond the reach of the others has no gradient to the coefficients
    if name != "fisheye":
        directions[1].zero_()
    steps = [
        [x + sign * 1e-8 * d for x, d in zip((wall, lens), directions, strict=True)]
        for sign in (1, -1)
    ]
    (after, high), (before, low) = (loss(*step) for step in steps)
    assert torch.equal(after, before) and (index >= 0).sum() > 40
    wanted = sum((g * d).sum() for g, d in zip(grads, directions, strict=True))
    assert float((high - low) / 2e-8) == pytest.approx(float(wanted), rel=1e-4, abs=1e-4)
