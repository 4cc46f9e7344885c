"""Viewpoints: ranges, whole objects in the picture, proper rotations, numbers that text files can hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

import nmr
from learn3d.data.poses import Poses
from learn3d.make_data.writers import WRITERS


def views(layout: str, radius: float, count: int, seed: int) -> Poses:
    """The cameras of a layout around an object of that radius."""
    writer = WRITERS[layout](Path("unused"), "chair")
    return writer.views(np.array([[radius, 0.0, 0.0]]), count, np.random.default_rng(seed))


def test_ranges_and_decimals():
    kar, r2n2, photos = (views(layout, 0.7, 4000, 0) for layout in ("kar", "r2n2", "photos"))
    for poses, azimuths, elevations in (
        (kar, (-180, 180), (-20, 40)),
        (r2n2, (-360, 0), (25, 30)),
        (photos, (-180, 180), (-10, 50)),
    ):
        for values, (low, high) in ((poses.azimuth_deg, azimuths), (poses.elevation_deg, elevations)):
            assert low <= values.min() and values.max() <= high
            spread = torch.histc(values, 8, low, high) / len(values)  # uniform
            assert (spread - 1 / 8).abs().max() < 0.03
            rounded = np.float32([float(f"{value:.4f}") for value in values.tolist()])
            np.testing.assert_array_equal(rounded, values.numpy())
    assert (r2n2.azimuth_deg > -360).all()  # R2N2's [0, 360)
    ratios = r2n2.distance / 1.75
    assert 0.65 <= ratios.min() and ratios.max() < 0.95 and ratios.max() - ratios.min() > 0.28
    assert 12 <= photos.half_fov_deg.min() and photos.half_fov_deg.max() <= 25


def test_the_whole_object_is_seen():
    vertices, faces = nmr.icosphere(3)
    for poses in (views("kar", 0.8, 30, 1), views("photos", 0.8, 30, 1)):
        alpha = nmr.render_silhouette(0.8 * vertices, faces, poses.cameras(), image_size=64)
        assert not alpha[:, [0, -1]].any() and not alpha[:, :, [0, -1]].any()
        assert (alpha.mean((1, 2)) > 0.3).all()  # and not from afar


def test_pascal3d_rotations_are_upright_but_for_the_tilt():
    in_object_frame = views("pascal3d", 0.8, 500, 2).rotation.double().numpy()
    rotations = in_object_frame @ WRITERS["pascal3d"].turn
    np.testing.assert_allclose(np.linalg.det(rotations), 1, rtol=1e-6)
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (500, 1, 1)), atol=1e-6)
    up = rotations[:, :, 1]  # the object's y in the picture: right, up, away
    tilt = np.rad2deg(np.arctan2(up[:, 0], up[:, 1]))
    assert np.abs(tilt).max() <= 15 and np.ptp(tilt) > 25
    elevation = np.rad2deg(np.arcsin(-up[:, 2]))  # seen from above, up comes towards the camera
    assert -10 <= elevation.min() < -5 and 35 < elevation.max() <= 40
