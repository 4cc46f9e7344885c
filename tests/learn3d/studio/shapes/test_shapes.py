"""Tests of the procedural shapes: closed, outward, connected, deterministic, varied, in the frame they promise."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage

import nmr
from learn3d.studio.shapes import CATEGORIES, make_shape, parts
from learn3d.studio.shapes.parts import Part, assemble, bar, box, ellipse, rectangle

every_category = pytest.mark.parametrize("category", CATEGORIES)


@lru_cache
def shapes(category: str) -> list[trimesh.Trimesh]:
    """The shapes of the seeds 0 to 99."""
    return [make_shape(category, np.random.default_rng(seed)) for seed in range(100)]


@lru_cache
def voxels(category: str) -> np.ndarray:
    """The 32^3 voxels of the first 50 shapes, by the metric's voxelizer."""
    return np.stack([voxelize(mesh) for mesh in shapes(category)[:50]])


def voxelize(mesh: trimesh.Trimesh) -> np.ndarray:
    vertices = torch.tensor(np.asarray(mesh.vertices) * 31 / 32 + 0.5, dtype=torch.float32)
    return nmr.voxelize(vertices, torch.tensor(np.asarray(mesh.faces)), size=32)[0].numpy()


def count_pieces(voxels: np.ndarray) -> int:
    return ndimage.label(voxels, np.ones((3, 3, 3)))[1]


@every_category
def test_every_component_is_closed_and_outward_and_the_box_is_centred(category: str) -> None:
    for seed, mesh in enumerate(shapes(category)):
        assert mesh.is_watertight and mesh.is_winding_consistent, f"{category} {seed} is not closed"
        assert mesh.area_faces.min() > 1e-12, f"{category} {seed} has a degenerate face"
        a, b, c = np.moveaxis(mesh.triangles - mesh.vertices.mean(0), 1, 0)
        label = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
        volumes = np.bincount(label, np.einsum("ij,ij->i", a, np.cross(b, c)))
        assert volumes.min() > 0, f"{category} {seed} has an inward component"
        lower, upper = mesh.bounds
        np.testing.assert_allclose(
            [*(lower + upper), (upper - lower).max()], [0, 0, 0, 1], atol=1e-9
        )
    counts = np.array([len(mesh.faces) for mesh in shapes(category)])
    assert 150 <= counts.min() and counts.max() <= 8500 and 400 <= np.median(counts) <= 6000


@every_category
def test_the_same_seed_gives_the_same_mesh_and_the_generator_moves_on(category: str) -> None:
    rng = np.random.default_rng(11)
    first, second, again = (make_shape(category, r) for r in (rng, rng, np.random.default_rng(11)))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.faces, again.faces)
    assert not np.array_equal(first.vertices, second.vertices)


@every_category
def test_shapes_of_a_category_differ(category: str) -> None:
    v = voxels(category)
    i, j = np.triu_indices(len(v), 1)
    iou = (v[i] & v[j]).sum((1, 2, 3)) / (v[i] | v[j]).sum((1, 2, 3))
    assert iou.mean() < 0.7
    assert np.quantile(iou, 0.98) < 0.95


@every_category
def test_shapes_are_connected(category: str) -> None:
    pieces = np.array([count_pieces(v) for v in voxels(category)])
    assert np.mean(pieces == 1) >= 0.96


@pytest.mark.parametrize(
    ("category", "limit"), [("airplane", -0.15), ("chair", -0.1), ("sofa", -0.05), ("car", -0.05)]
)
def test_front_is_towards_positive_z_and_up_is_y(category: str, limit: float) -> None:
    """Fins of airplanes and backs of chairs and sofas are high and at -z; the bonnet of a car is low and at +z."""
    vertices = [np.asarray(mesh.vertices) for mesh in shapes(category)]
    assert np.mean([v[v[:, 1] > 0.8 * v[:, 1].max(), 2].mean() for v in vertices]) < limit


@pytest.mark.parametrize("category", ["airplane", "car", "chair"])
def test_left_and_right_agree(category: str) -> None:
    centroids = np.array(
        [mesh.triangles_center.T @ mesh.area_faces / mesh.area for mesh in shapes(category)]
    )
    assert np.abs(centroids[:, 0]).max() < 0.02


def test_cars_without_loads_are_the_same_cars_without_boxes_on_their_roofs() -> None:
    pairs = [
        [make_shape("car", np.random.default_rng(seed), loads=loads) for loads in (True, False)]
        for seed in range(20)
    ]
    lost = [loaded.body_count - bare.body_count for loaded, bare in pairs]
    assert set(lost) == {0, 3}, "a box and two bars"
    for (loaded, bare), gone in zip(pairs, lost, strict=True):
        np.testing.assert_allclose(loaded.extents[::2], bare.extents[::2])
        assert (loaded.extents[1] - bare.extents[1] > 0.04) == (gone > 0)


def test_unknown_category_names_the_known_ones() -> None:
    with pytest.raises(
        ValueError, match=r"category must be one of airplane, .*table; got 'teapot'"
    ):
        make_shape("teapot", np.random.default_rng(0))


SQUARE = rectangle(0.4, 0.4, segments=0)


def _grid() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(0, 3, 4))
    return np.stack([x, y, 0.2 * x**2], 2)


@pytest.mark.parametrize(
    ("part", "volume"),
    [
        (box((2, 3, 1), radius=0.01), 6.0),
        (parts.slab(rectangle(2, 3, 0.01), 0.5, bevel=0.01), 3.0),
        (parts.slab(ellipse(2, 2, 64), 0.5, bevel=0.01), 0.5 * np.pi),
        (parts.post((0, 0, 0), (1, 2, 0), rectangle(1, 1, segments=0), [(0, 1), (1, 1)]), 2.0),
        (parts.revolve([(1, 0), (0.001, 3)], 64), np.pi),
        (parts.revolve([(2, 0), (3, 0), (3, 1), (2, 1)], 64, hollow=True), 5 * np.pi),
        (parts.ellipsoid((2, 4, 6), sides=48, stacks=48), 8 * np.pi),
        (bar((0, 0, 0), (0, 0, 5), 0.5, 0.2), 0.5),
        (parts.tube([(0, 0, 0), (2, 0, 0), (2, 2, 0)], 0.5, SQUARE), 0.04 * 4),
        (
            parts.tube([(1, 1, 0), (-1, 1, 0), (-1, -1, 0), (1, -1, 0)], 0.5, SQUARE, closed=True),
            0.32,
        ),
        (parts.sheet(_grid(), 0.1), 0.1 * 6 * 1.026),
        (
            parts.wing([(-1, 0, 0, 1, 0.1), (1, 0, 0, 1, 0.1)]),
            2 * 0.0695,
        ),  # the profile has 14 corners
    ],
    ids=lambda value: None if isinstance(value, float) else "",
)
def test_parts_are_closed_and_have_the_volume_of_the_formula(part: Part, volume: float) -> None:
    mesh = assemble(part)
    extent = np.ptp(part[0][0].reshape(-1, 3), axis=0).max()
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume * extent**3 == pytest.approx(volume, rel=0.03)
    mirrored = assemble(part.scaled(x=-1))
    assert mirrored.volume == pytest.approx(mesh.volume)


POINT = box((0.1, 0.1, 0.1), (1, 0, 2))


@pytest.mark.parametrize(
    ("part", "centers"),
    [
        (POINT.rotated("z", 90), [(0, 1, 2)]),
        (POINT.rotated("y", 90), [(2, 0, -1)]),
        (POINT.rotated("x", 90, about=(0, 1, 0)), [(1, -1, -1)]),
        (POINT.both_sides(), [(1, 0, 2), (-1, 0, 2)]),
        (POINT.four_corners(), [(1, 0, 2), (-1, 0, 2), (1, 0, -2), (-1, 0, -2)]),
        (POINT.around([0, 90]), [(1, 0, 2), (2, 0, -1)]),
        (POINT + POINT.moved(y=1), [(1, 0, 2), (1, 1, 2)]),
    ],
)
def test_parts_are_turned_right_handedly_mirrored_and_joined(part: Part, centers: list) -> None:
    np.testing.assert_allclose([rings.mean((0, 1)) for rings, _ in part], centers, atol=1e-12)


def test_thin_bars_do_not_vanish_between_the_rays_of_the_voxelizer() -> None:
    """A slanted rod much thinner than a voxel stays one piece from end to end."""
    voxels = voxelize(assemble(bar((0, 0, 0), (0.35, 0.98, 0.27), 0.006)))
    assert count_pieces(voxels) == 1
    assert voxels.any((0, 2)).sum() >= 31
