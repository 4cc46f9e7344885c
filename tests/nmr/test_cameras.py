"""LookAt: geometry, published values, batches, gradients, errors."""

import math

import numpy as np
import pytest
import torch
from vectors import load_vector

import nmr
from nmr.cameras import points_from_angles


def test_the_origin_is_at_the_centre_at_the_eye_distance():
    camera = nmr.LookAt.from_angles(2.5, [0.0, 30.0, -40.0], [0.0, 77.0, 200.0])
    out = camera.transform(torch.zeros(1, 1, 3))
    torch.testing.assert_close(out, torch.tensor([[[0.0, 0.0, 2.5]]]).expand(3, 1, 3), atol=1e-6, rtol=0)


def test_axes_from_azimuth_zero():
    """The eye is on -z: x points right, y up, and the edge of the field of view maps to 1."""
    camera = nmr.LookAt.from_angles(2.0, 0.0, 0.0, half_fov_deg=30.0)
    edge = 2.0 * math.tan(math.radians(30.0))
    points = torch.tensor([[edge, 0.0, 0.0], [0.0, edge, 0.0], [0.0, 0.0, 1.0]])
    expected = torch.tensor([[[1.0, 0.0, 2.0], [0.0, 1.0, 2.0], [0.0, 0.0, 3.0]]])
    torch.testing.assert_close(camera.transform(points), expected, atol=1e-6, rtol=0)


def test_points_from_angles():
    torch.testing.assert_close(
        points_from_angles(2.0, 0.0, 90.0).float(), torch.tensor([2.0, 0.0, 0.0]), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        points_from_angles(2.0, 90.0, 0.0).float(), torch.tensor([0.0, 2.0, 0.0]), atol=1e-6, rtol=0
    )
    assert points_from_angles([1.0, 2.0], 30.0, torch.tensor([0.0, 10.0])).shape == (2, 3)


def test_published_training_render():
    """renderer_learn3d_sil64: the published Renderer with the camera and settings of the published training code."""
    v = load_vector("renderer_learn3d_sil64")
    eye = torch.from_numpy(np.atleast_1d(v["param_eye"]))
    vertices = torch.from_numpy(v["vertices"]).requires_grad_()
    camera = nmr.LookAt(eye, half_fov_deg=float(v["renderer_viewing_angle"]))
    alpha = nmr.render_silhouette(
        vertices, torch.from_numpy(v["faces"]), camera, image_size=int(v["renderer_image_size"])
    )
    image = next(k for k in v if k.startswith("out_"))
    alpha.backward(torch.from_numpy(v[image.replace("out_", "upstream_")]))
    assert np.array_equal(alpha.detach().numpy(), v[image])
    difference = np.linalg.norm(vertices.grad.numpy() - v["grad_vertices"]) / np.linalg.norm(v["grad_vertices"])
    assert difference < 1e-4  # bit for bit with the same BLAS


def test_one_mesh_many_views_and_many_meshes_one_view():
    vertices, faces = nmr.icosphere(1)
    views = nmr.LookAt.from_angles(3.0, 0.0, [0.0, 120.0])
    assert nmr.render_silhouette(0.5 * vertices, faces, views, image_size=8).shape == (2, 8, 8)
    one = nmr.LookAt([0.0, 0.0, -3.0])
    assert nmr.render_silhouette(vertices.expand(4, -1, -1), faces, one, image_size=8).shape == (4, 8, 8)


def test_gradients_reach_the_eye():
    torch.manual_seed(0)
    points = torch.rand(1, 5, 3, dtype=torch.float64)
    eye = torch.tensor([[0.3, 1.0, -3.0], [2.0, 0.5, 1.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda e: nmr.LookAt(e).transform(points), eye)


def test_eye_on_the_up_axis_is_degenerate_but_finite():
    assert nmr.LookAt([0.0, 2.0, 0.0]).transform(torch.rand(1, 4, 3)).isfinite().all()


def test_any_object_with_transform_is_a_camera():
    class Shift:
        def transform(self, vertices):
            return vertices + torch.tensor([0.0, 0.0, 2.0])

    vertices, faces = nmr.icosphere(1)
    assert nmr.render_silhouette(0.5 * vertices, faces, Shift(), image_size=8).any()


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: nmr.LookAt([0.0, 1.0]), r"eye must have shape \[3\] or \[B, 3\], got \[2\]"),
        (lambda: nmr.LookAt([0.0, 0.0, 1.0], half_fov_deg=90.0), "between 0 and 90"),
        (lambda: nmr.LookAt([0.0, 0.0, 1.0], half_fov_deg=torch.ones(2)), "must be a number"),
        (
            lambda: nmr.LookAt.from_angles([1.0, 2.0], 0.0, [0.0, 1.0, 2.0]),
            r"one length, got shapes \[2\], \[\], \[3\]",
        ),
        (lambda: nmr.LookAt(torch.rand(2, 3)).transform(torch.rand(3, 4, 3)), r"3 meshes, eye \[2, 3\]"),
    ],
)
def test_errors(make, words):
    with pytest.raises(ValueError, match=words):
        make()
