"""Lit pictures: coverage equals the silhouette, light falls where it should, errors are clear."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import nmr
from learn3d.data.conventions import view_cameras
from learn3d.data.poses import RotationPoses
from learn3d.pictures.studio import BACK_LIGHT, photograph, studio_lights

WHITE = np.ones(3, dtype=np.float32)


@pytest.fixture
def square():
    """A square in the plane z = 0 that the camera of azimuth 0, elevation 0 sees face on."""
    vertices = 0.4 * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return vertices, torch.tensor([[0, 1, 2], [0, 2, 3]])


def test_alpha_equals_the_antialiased_silhouette():
    vertices, faces = nmr.icosphere(2)
    vertices = vertices * torch.tensor([0.45, 0.2, 0.3])
    cameras = view_cameras(torch.arange(24))
    _, alpha = photograph(vertices, faces, WHITE, cameras, image_size=64)
    wanted = nmr.render_silhouette(vertices, faces, cameras, image_size=64)
    np.testing.assert_array_equal(alpha, np.rint(255 * wanted.numpy()).astype(np.uint8))
    assert set(np.unique(alpha)) == {0, 64, 128, 191, 255}


def test_colour_is_lambert_on_either_winding(square):
    vertices, faces = square
    camera = nmr.LookAt.from_angles(2.732, 0.0, [0.0, 180.0], half_fov_deg=15.0)
    color = np.array([0.8, 0.4, 0.2], dtype=np.float32)
    light = (0.0, 3.0, -4.0)  # 4/5 of it along -z, towards the camera of azimuth 0
    for f in (faces, faces[:, [2, 1, 0]]):
        rgb, _ = photograph(vertices, f, color, camera, image_size=32, lights=studio_lights(light, 0.5))
        np.testing.assert_array_equal(rgb[0, 16, 16], np.rint(255 * color * (0.5 + 0.5 * 0.8)))
        np.testing.assert_array_equal(rgb[1, 16, 16], np.rint(255 * color * (0.5 + 0.5 * 0.8 * BACK_LIGHT)))
        np.testing.assert_array_equal(rgb[:, 0, 0], 255)


def test_edge_pixels_are_the_mean_of_surface_and_paper(square):
    vertices, faces = square
    camera = nmr.LookAt.from_angles(2.732, 0.0, 0.0, half_fov_deg=15.0)
    rgb, alpha = photograph(vertices, faces, 0 * WHITE, camera, image_size=33, supersample=4)
    np.testing.assert_allclose(rgb[..., 0], 255.0 - alpha, atol=1.0)  # black on white
    assert ((alpha > 0) & (alpha < 255)).any()


def test_each_face_keeps_its_own_colour(square):
    vertices, faces = square
    camera = nmr.LookAt.from_angles(2.732, 0.0, 0.0, half_fov_deg=15.0)
    rgb, _ = photograph(
        vertices, faces, np.float32([[1, 0, 0], [0, 0, 1]]), camera, image_size=32, lights=studio_lights(ambient=1.0)
    )
    # face 0 holds the lower right corner of the square (x right, y up), face 1 the upper left one
    np.testing.assert_array_equal(rgb[0, 21, 23], [255, 0, 0])
    np.testing.assert_array_equal(rgb[0, 10, 8], [0, 0, 255])


def test_parallel_rays_light_the_side_that_they_meet(square):
    vertices, faces = square
    rotation = torch.diag(torch.tensor([1.0, 1, -1]))  # from behind: +z is towards the camera
    color = np.array([0.8, 0.4, 0.2], dtype=np.float32)
    cameras = RotationPoses(torch.stack([torch.eye(3), rotation])).cameras()
    lights = studio_lights((0.0, 3.0, -4.0))
    rgb, alpha = photograph(vertices, faces, color, cameras, image_size=32, lights=lights)
    np.testing.assert_array_equal(rgb[0, 16, 16], np.rint(255 * color * (0.5 + 0.5 * 0.8)))
    np.testing.assert_array_equal(rgb[1, 16, 16], np.rint(255 * color * (0.5 + 0.5 * 0.8 * BACK_LIGHT)))
    wanted = nmr.render_silhouette(vertices, faces, cameras, image_size=32)
    np.testing.assert_array_equal(alpha, np.rint(255 * wanted.numpy()))


def test_faces_without_area_give_no_nan(square):
    vertices, faces = square
    faces = torch.cat([faces, torch.tensor([[0, 0, 0], [0, 1, 1]])])
    with np.errstate(all="raise"):
        rgb, _ = photograph(vertices, faces, WHITE, view_cameras(torch.arange(3)), image_size=16)
    assert rgb.shape == (3, 16, 16, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": torch.zeros(2, 4, 3)}, r"vertices must be \[V, 3\]"),
        ({"face_colors": np.ones((5, 3))}, r"\[3\] or \[2, 3\]"),
        ({"supersample": 3}, "even number"),
        ({"image_size": 0}, "at least 1"),
    ],
)
def test_errors(square, change, message):
    arguments = {"vertices": square[0], "faces": square[1], "face_colors": WHITE, "cameras": view_cameras([0])}
    with pytest.raises(ValueError, match=message):
        photograph(**{**arguments, "image_size": 16, **change})


@pytest.mark.parametrize(
    ("settings", "message"),
    [(((0.0, 0.0, 0.0),), "not all zero"), (((0.0, float("nan"), 0.0),), "finite"), (((0, 1, 0), 1.5), "ambient")],
)
def test_errors_of_lights(settings, message):
    with pytest.raises(ValueError, match=message):
        studio_lights(*settings)
