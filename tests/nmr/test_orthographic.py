"""Cameras without perspective: depth, weights and whatever is interpolated are linear on the screen."""

from __future__ import annotations

import math

import numpy as np
import pytest
import reference
import torch

import nmr
from nmr.cameras import from_opengl, from_pytorch3d

SIZE = 24


def soup(
    seed: int, faces: int = 12, dtype: torch.dtype = torch.float64
) -> tuple[torch.Tensor, torch.Tensor]:
    """Triangles around the origin, each with its own corners."""
    rng = np.random.default_rng(seed)
    centres, spread = rng.uniform(-0.7, 0.7, (faces, 1, 3)), rng.uniform(-0.7, 0.7, (faces, 3, 3))
    return torch.tensor((centres + spread).reshape(-1, 3), dtype=dtype), torch.arange(
        3 * faces
    ).reshape(-1, 3)


def cast_rays(
    points: torch.Tensor, faces: torch.Tensor, size: int, near: float, far: float
) -> list[list[tuple]]:
    """What rays along z through the pixel centres hit: for each pixel (depth, face, weights), nearest first."""
    found = []
    for row in range(size):
        for column in range(size):
            x, y = (2 * column + 1 - size) / size, (size - 2 * row - 1) / size
            hits = []
            for number, (a, b, c) in enumerate(points[faces].numpy()):
                plane = np.array([[p[0], p[1], 1.0] for p in (a, b, c)]).T
                if abs(np.linalg.det(plane)) < 1e-12:
                    continue
                weights = np.linalg.solve(plane, [x, y, 1.0])
                depth = weights @ [a[2], b[2], c[2]]
                if weights.min() >= 0 and near < depth < far:
                    hits.append((depth, number, weights))
            found.append(sorted(hits, key=lambda hit: hit[0]))
    return found


@pytest.mark.parametrize("seed", range(4))
def test_it_shows_what_parallel_rays_hit(seed) -> None:
    vertices, faces = soup(seed)
    camera = nmr.Orthographic([0.3, 0.5, -3.0], scale=0.8)
    points, layers = camera.transform(vertices)[0], 3
    fragments = nmr.render_fragments(
        vertices,
        faces,
        camera,
        image_size=SIZE,
        anti_aliasing=False,
        faces_per_pixel=layers,
        near=1.0,
        far=9.0,
    )
    colors = torch.rand(len(vertices), 4, dtype=vertices.dtype)
    values = fragments.interpolate(colors)[0].reshape(-1, layers, 4)
    index, depth, weights = (
        x[0].reshape(SIZE * SIZE, layers, *x.shape[4:]).numpy()
        for x in (fragments.face_index, fragments.depth, fragments.weights)
    )
    single = nmr.render_fragments(
        vertices, faces, camera, image_size=SIZE, anti_aliasing=False, near=1.0, far=9.0
    )
    assert np.array_equal(single.face_index[0].reshape(-1), index[:, 0]), (
        "the first layer is what is seen"
    )
    drawn = nmr.render_depth(
        vertices, faces, camera, image_size=SIZE, anti_aliasing=False, near=1.0, far=9.0
    )
    assert np.array_equal(drawn[0].reshape(-1), depth[:, 0])
    hits = cast_rays(points, faces, SIZE, 1.0, 9.0)
    assert sum(len(hit) > 1 for hit in hits) > 10
    for pixel, found in enumerate(hits):
        assert index[pixel].tolist() == [
            *(hit[1] for hit in found[:layers]),
            *[-1] * (layers - len(found)),
        ]
        for k, (z, face, own) in enumerate(found[:layers]):
            assert depth[pixel, k] == pytest.approx(z, abs=1e-12)
            assert np.allclose(weights[pixel, k], own, atol=1e-12)
            assert np.allclose(values[pixel, k], own @ colors[faces[face]].numpy(), atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("seed", range(6))
def test_kernels_round_as_the_definition(seed, dtype) -> None:
    vertices, faces = soup(seed, 200, dtype)
    vertices[:, 2] += 5 + 1e-3 * seed
    near, far = 4.5, 6.0
    index = nmr.ops.rasterize(vertices[None], faces, None, 37, 29, True, near, far, False)
    slow = reference.face_index(vertices, faces, (37, 29), True, near, far, perspective=False)
    assert torch.equal(index[0].flip(0).long(), slow)
    weights, depth = nmr.ops.fragments(vertices[None], faces, None, index, far, False)
    slow_weights, slow_depth = reference.fragments(vertices, faces, slow, far, perspective=False)
    tight = {"rtol": 0, "atol": 2e-4 if dtype == torch.float32 else 1e-12}
    torch.testing.assert_close(weights[0].flip(0), slow_weights, **tight)
    torch.testing.assert_close(depth[0].flip(0), slow_depth, **tight)


@pytest.mark.parametrize("seed", range(3))
def test_gradients_are_those_of_the_definition_and_of_finite_differences(seed) -> None:
    vertices, faces = soup(seed)
    vertices[:, 2] += 4
    index = nmr.ops.rasterize(vertices[None], faces, None, SIZE, SIZE, True, 0.1, 9.0, False)
    upstream = torch.randn(SIZE, SIZE, 4, dtype=vertices.dtype)

    def loss(x, anti_aliased, slow=False):
        if slow:
            weights, depth = (
                y.flip(0)
                for y in reference.fragments(x, faces, index[0].flip(0).long(), 9.0, False)
            )
        else:
            weights, depth = (
                y[0] for y in nmr.ops.fragments(x[None], faces, None, index, 9.0, False)
            )
        if anti_aliased:
            image = nmr.ops.depth_image(x[None], faces, None, index, True, 9.0, False)[0]
            return (image * upstream[: SIZE // 2, : SIZE // 2, 0]).sum()
        return (weights * upstream[..., :3]).sum() + (depth * upstream[..., 3]).sum()

    leaf = vertices.clone().requires_grad_()
    (fast,) = torch.autograd.grad(loss(leaf, False), leaf)
    (slow,) = torch.autograd.grad(loss(leaf, False, True), leaf)
    torch.testing.assert_close(fast, slow, rtol=1e-8, atol=1e-8)
    direction, step = torch.randn_like(vertices), 1e-7
    for anti_aliased in (False, True):
        (grad,) = torch.autograd.grad(loss(leaf, anti_aliased), leaf)
        ends = [loss(vertices + sign * step * direction, anti_aliased) for sign in (1, -1)]
        measured, wanted = (ends[0] - ends[1]) / (2 * step), (grad * direction).sum()
        assert float(measured) == pytest.approx(float(wanted), rel=1e-4, abs=1e-4)


def test_faces_cut_at_the_near_plane_keep_depth_and_weights() -> None:
    vertices, faces = soup(5, 30)
    camera = nmr.Orthographic([0.0, 0.0, -1.0])
    how = {"image_size": SIZE, "anti_aliasing": False, "near": 0.8, "far": 9.0}
    cut = nmr.render_fragments(vertices, faces, camera, **how)
    whole = nmr.render_fragments(vertices, faces, camera, clip=False, **how)
    assert (camera.transform(vertices)[..., 2] < 0.8).any()
    assert torch.equal(cut.face_index, whole.face_index)
    torch.testing.assert_close(cut.weights, whole.weights, rtol=0, atol=1e-12)
    torch.testing.assert_close(cut.depth, whole.depth, rtol=0, atol=1e-12)


def test_all_cameras_without_perspective_show_the_same() -> None:
    vertices, faces = soup(7, 40)

    def image_of(camera: object) -> torch.Tensor:
        return nmr.render_depth(vertices, faces, camera, image_size=SIZE, anti_aliasing=False)

    ours = image_of(nmr.Orthographic([0.0, 0.0, 3.0], scale=0.7, right_handed=True))
    view, clip = torch.eye(4), torch.diag(torch.tensor([0.7, 0.7, -0.1, 1.0]))
    view[2, 3] = -3.0
    theirs = from_pytorch3d(
        torch.diag(torch.tensor([-1.0, 1.0, -1.0])), [0.0, 0.0, 3.0], 0.7, orthographic=True
    )
    moving = _Parallel(3.0, 0.7)
    for camera in (from_opengl(view, clip), theirs, moving):
        torch.testing.assert_close(image_of(camera), ours, rtol=0, atol=1e-6)


class _Parallel:
    """A camera of one's own."""

    perspective = False

    def __init__(self, distance: float, scale: float) -> None:
        self.distance, self.scale = distance, scale

    def transform(self, vertices, starts=None):
        x, y, z = vertices.unbind(-1)
        return torch.stack([self.scale * x, self.scale * y, self.distance - z], dim=-1)


def test_mipmaps_of_a_tilted_square_have_one_level() -> None:
    vertices = torch.tensor(
        [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 3.0], [-1.0, 1.0, 3.0]]
    )
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uv = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    camera = nmr.Orthographic([0.0, 0.0, -2.0])
    fragments = nmr.render_fragments(vertices, faces, camera, image_size=32, anti_aliasing=False)
    texture = nmr.UVTexture(torch.rand(256, 256, 1), uv, filter="mipmap")
    levels = []
    original = nmr.ops.uv_levels
    try:
        nmr.ops.uv_levels = lambda *args: levels.append(original(*args)) or levels[-1]
        texture.sample(fragments)
    finally:
        nmr.ops.uv_levels = original
    covered = levels[0][fragments.covered]
    assert torch.allclose(covered, torch.full_like(covered, math.log2(256 / 32)), atol=1e-3)
