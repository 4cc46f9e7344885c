"""Meshes made fit: welded, refused, as grids of their surface."""

from __future__ import annotations

import numpy as np
import pytest
from memory_checks import at_most
from small_packages import box

from learn3d.make_data.debian.mesh_cleaning import clean_mesh, overlap, surface_grid
from learn3d.make_data.debian.mesh_text import triangulate
from learn3d.make_data.meshes import is_watertight


def test_clean_mesh_welds_and_drops():
    corners, quads = box((0, 0, 0), (2, 1, 1))
    soup = triangulate(quads, corners)
    vertices = np.concatenate([corners[soup].reshape(-1, 3), [[99, 99, 99]]])
    faces = np.concatenate([np.arange(36).reshape(-1, 3), [[0, 0, 1]], [[2, 1, 0]]])
    mesh = clean_mesh(vertices, faces)
    points, clean = mesh.vertices, mesh.faces
    assert (points.shape, clean.shape) == ((8, 3), (12, 3))
    assert is_watertight(points, clean) and not is_watertight(points, clean[1:])
    np.testing.assert_allclose(np.ptp(points, axis=0), [1, 0.5, 0.5])
    np.testing.assert_allclose(points.min(axis=0) + points.max(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (np.zeros((3, 3)), "no usable extent"),
        (np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2.0]]), "no face has an area"),
        (np.array([[0, 0, 0], [1, 0, 0], [0, 1.0, 0]]), "flat"),
        (np.array([[0, 0, 0], [np.nan, 0, 0], [0, 1.0, 0]]), "not finite"),
    ],
)
def test_clean_mesh_refuses(vertices: np.ndarray, message: str):
    with pytest.raises(ValueError, match=message):
        clean_mesh(vertices, np.array([[0, 1, 2]]))


def test_surface_grid_of_a_box():
    corners, quads = box((0, 0, 0), (2, 1.2, 0.8))
    faces = triangulate(quads, corners)
    cube = surface_grid(corners, faces, 8, per_axis=True)
    shell = np.ones((8, 8, 8), bool)
    shell[1:-1, 1:-1, 1:-1] = False
    np.testing.assert_array_equal(cube, shell)
    flat = surface_grid(corners, faces, 8)
    assert [int(flat.any(axis=axes).sum()) for axes in ((1, 2), (0, 2), (0, 1))] == [8, 6, 4]
    assert overlap(cube, cube) == 1 and overlap(cube, flat) < 0.5


def test_large_faces_are_sampled_piece_by_piece():
    rng = np.random.default_rng(0)
    vertices = rng.uniform(-0.5, 0.5, (600, 3))
    with at_most(2**28):
        grid = surface_grid(vertices, np.arange(600).reshape(-1, 3), 64)
    assert grid.mean() > 0.1
