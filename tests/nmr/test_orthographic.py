"""Cameras without perspective: depth, weights and whatever is interpolated are linear on the screen."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import double, uniform
from torch.testing import assert_close

import nmr
from nmr.cameras import from_opengl, from_pytorch3d

SIZE, NEAR, FAR = 24, 1.0, 9.0


def soup(seed: int, faces: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Triangles around the origin, each with its own corners."""
    rng = np.random.default_rng(seed)
    centres, spread = rng.uniform(-0.7, 0.7, (faces, 1, 3)), rng.uniform(-0.7, 0.7, (faces, 3, 3))
    return double((centres + spread).reshape(-1, 3)), torch.arange(3 * faces).view(-1, 3)


def hits_of_ray(x: float, y: float, points: np.ndarray, faces: np.ndarray) -> list[tuple]:
    """What a ray along z hits: (depth, face, weights), nearest first."""
    hits = []
    for number, corners in enumerate(points[faces]):
        plane = np.vstack([corners[:, :2].T, np.ones(3)])
        weights = np.linalg.solve(plane, [x, y, 1.0])
        depth = weights @ corners[:, 2]
        if weights.min() >= 0 and NEAR < depth < FAR:
            hits.append((depth, number, weights))
    return sorted(hits, key=lambda hit: hit[0])


@pytest.mark.parametrize("seed", range(4))
def test_it_shows_what_parallel_rays_hit(seed) -> None:
    vertices, faces = soup(seed)
    camera = nmr.Orthographic([0.3, 0.5, -3.0], scale=0.8)
    points, layers = camera.transform(vertices)[0].numpy(), 3
    how = dict(image_size=SIZE, near=NEAR, far=FAR)
    fragments = nmr.render_fragments(vertices, faces, camera, faces_per_pixel=layers, **how)
    single = nmr.render_fragments(vertices, faces, camera, **how)
    assert torch.equal(single.face_index, fragments.face_index[..., 0]), "layer 0 is what is seen"
    drawn = nmr.render_depth(vertices, faces, camera, anti_aliasing=False, **how)
    assert torch.equal(drawn, fragments.depth[..., 0])
    colors = uniform(len(vertices), 4)
    values, index, depth, weights = (
        x[0].numpy()
        for x in (
            fragments.interpolate(colors),
            fragments.face_index,
            fragments.depth,
            fragments.weights,
        )
    )
    several = 0
    for row, column in np.ndindex(SIZE, SIZE):
        x, y = (2 * column + 1 - SIZE) / SIZE, (SIZE - 2 * row - 1) / SIZE
        found, at = hits_of_ray(x, y, points, faces.numpy()), (row, column)
        several += len(found) > 1
        wanted = [hit[1] for hit in found[:layers]]
        assert index[at].tolist() == wanted + [-1] * (layers - len(wanted))
        for k, (z, face, own) in enumerate(found[:layers]):
            assert depth[at][k] == pytest.approx(z, abs=1e-12)
            assert np.allclose(weights[at][k], own, atol=1e-12)
            assert np.allclose(values[at][k], own @ colors[faces[face]].numpy(), atol=1e-12)
    assert several > 10


def test_faces_cut_at_the_near_plane_keep_depth_and_weights() -> None:
    vertices, faces = soup(5, 30)
    camera, how = nmr.Orthographic([0.0, 0.0, -1.0]), dict(image_size=SIZE, near=0.8, far=FAR)
    cut, whole = (
        nmr.render_fragments(vertices, faces, camera, clip=clip, **how) for clip in (True, False)
    )
    assert (camera.transform(vertices)[..., 2] < 0.8).any()
    assert torch.equal(cut.face_index, whole.face_index)
    assert_close([cut.weights, cut.depth], [whole.weights, whole.depth], rtol=0, atol=1e-12)


def test_all_cameras_without_perspective_show_the_same() -> None:
    view = np.diag([1.0, 1.0, 1.0, 1.0])
    view[2, 3] = -3.0
    turn = np.diag([-1.0, 1.0, -1.0])
    ours, *others = (
        nmr.render_depth(*soup(7, 40), camera, image_size=SIZE, anti_aliasing=False)
        for camera in (
            nmr.Orthographic([0.0, 0.0, 3.0], scale=0.7, right_handed=True),
            from_opengl(view, np.diag([0.7, 0.7, -0.1, 1.0])),
            from_pytorch3d(turn, [0.0, 0.0, 3.0], 0.7, orthographic=True),
            _Parallel(),
        )
    )
    for image in others:
        assert_close(image, ours, rtol=0, atol=1e-6)


class _Parallel:
    """A camera of one's own."""

    perspective = False

    def transform(self, vertices, starts=None):
        return vertices * double([0.7, 0.7, -1.0]) + double([0.0, 0.0, 3.0])
