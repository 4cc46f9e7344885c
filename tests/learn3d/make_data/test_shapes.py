"""Tests of the procedural shapes: closed, outward, connected, deterministic, varied, in the frame they promise."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import nmr
from learn3d.make_data.shapes import CATEGORIES, make_shape
from learn3d.make_data.shapes.draw import Draw
from learn3d.make_data.shapes.parts import (
    assemble,
    bar,
    box,
    ellipse,
    ellipsoid,
    inset,
    post,
    rectangle,
    revolve,
    rounded_path,
    sheet,
    slab,
    tube,
    wing,
)

SEEDS = 100


@pytest.fixture(scope="module")
def shapes() -> dict[str, list[trimesh.Trimesh]]:
    """The shapes of the seeds 0..SEEDS-1 of every category."""
    return {c: [make_shape(c, np.random.default_rng(seed)) for seed in range(SEEDS)] for c in CATEGORIES}


@pytest.fixture(scope="module")
def voxels(shapes: dict[str, list[trimesh.Trimesh]]) -> dict[str, np.ndarray]:
    """The 32^3 voxels of the first 50 shapes of every category, by the metric's voxeliser."""
    return {c: np.stack([_voxelize(mesh) for mesh in meshes[:50]]) for c, meshes in shapes.items()}


def _voxelize(mesh: trimesh.Trimesh) -> np.ndarray:
    vertices = torch.tensor(np.asarray(mesh.vertices) * 31 / 32 + 0.5, dtype=torch.float32)
    return nmr.voxelize(vertices, torch.tensor(np.asarray(mesh.faces)), size=32)[0].numpy()


def _component_volumes(mesh: trimesh.Trimesh) -> np.ndarray:
    """The signed volume of each connected component."""
    faces, vertices = np.asarray(mesh.faces), np.asarray(mesh.vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (len(vertices), len(vertices)))
    count, label = connected_components(graph, directed=False)
    center = np.stack([np.bincount(label, vertices[:, k]) for k in range(3)], 1) / np.bincount(label)[:, None]
    a, b, c = (vertices[faces[:, k]] - center[label[faces[:, 0]]] for k in range(3))
    return np.bincount(label[faces[:, 0]], np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, minlength=count)


@pytest.mark.parametrize("category", CATEGORIES)
def test_every_component_is_closed_and_outward(category: str, shapes: dict[str, list[trimesh.Trimesh]]) -> None:
    for seed, mesh in enumerate(shapes[category]):
        assert np.isfinite(mesh.vertices).all(), f"{category} {seed} has a vertex that is not finite"
        assert mesh.is_watertight and mesh.is_winding_consistent, f"{category} {seed} is not closed"
        assert _component_volumes(mesh).min() > 0, f"{category} {seed} has an inward component"
        assert mesh.area_faces.min() > 1e-12, f"{category} {seed} has a degenerate face"


@pytest.mark.parametrize("category", CATEGORIES)
def test_face_counts_stay_small(category: str, shapes: dict[str, list[trimesh.Trimesh]]) -> None:
    counts = np.array([len(mesh.faces) for mesh in shapes[category]])
    assert counts.min() >= 150
    assert counts.max() <= 8500
    assert 400 <= np.median(counts) <= 6000


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_box_is_centred_and_its_longest_side_is_one(
    category: str, shapes: dict[str, list[trimesh.Trimesh]]
) -> None:
    for mesh in shapes[category]:
        lower, upper = mesh.bounds
        np.testing.assert_allclose(lower + upper, 0, atol=1e-9)
        np.testing.assert_allclose((upper - lower).max(), 1, atol=1e-9)


@pytest.mark.parametrize("category", CATEGORIES)
def test_the_same_seed_gives_the_same_mesh_and_the_generator_moves_on(category: str) -> None:
    rng = np.random.default_rng(11)
    first, second = make_shape(category, rng), make_shape(category, rng)
    again = make_shape(category, np.random.default_rng(11))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.faces, again.faces)
    assert first.vertices.shape != second.vertices.shape or not np.array_equal(first.vertices, second.vertices)


@pytest.mark.parametrize("category", CATEGORIES)
def test_shapes_of_a_category_differ(category: str, voxels: dict[str, np.ndarray]) -> None:
    v = voxels[category]
    i, j = np.triu_indices(len(v), 1)
    iou = (v[i] & v[j]).sum((1, 2, 3)) / (v[i] | v[j]).sum((1, 2, 3))
    assert iou.mean() < 0.7
    assert np.quantile(iou, 0.98) < 0.95


@pytest.mark.parametrize("category", CATEGORIES)
def test_shapes_are_connected(category: str, voxels: dict[str, np.ndarray]) -> None:
    pieces = [ndimage.label(v, np.ones((3, 3, 3)))[1] for v in voxels[category]]
    assert min(pieces) == 1
    assert np.mean(np.array(pieces) == 1) >= 0.96


def test_front_is_towards_positive_z_and_up_is_y(shapes: dict[str, list[trimesh.Trimesh]]) -> None:
    """Fins of airplanes and backs of chairs and sofas are high and at -z; the bonnet of a car is low and at +z."""

    def mean_z_of_the_top(meshes: list[trimesh.Trimesh]) -> float:
        vertices = [np.asarray(m.vertices) for m in meshes]
        return float(np.mean([v[v[:, 1] > 0.8 * v[:, 1].max(), 2].mean() for v in vertices]))

    assert mean_z_of_the_top(shapes["airplane"]) < -0.15
    assert mean_z_of_the_top(shapes["chair"]) < -0.1
    assert mean_z_of_the_top(shapes["sofa"]) < -0.05
    assert mean_z_of_the_top(shapes["car"]) < -0.05


@pytest.mark.parametrize("category", ["airplane", "car", "chair"])
def test_left_and_right_agree(category: str, shapes: dict[str, list[trimesh.Trimesh]]) -> None:
    centroids = np.array([mesh.triangles_center.T @ mesh.area_faces / mesh.area for mesh in shapes[category]])
    assert np.abs(centroids[:, 0]).max() < 0.02


def test_unknown_category_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"category must be one of airplane, .*table; got 'teapot'"):
        make_shape("teapot", np.random.default_rng(0))


def test_a_seed_instead_of_a_generator_is_refused() -> None:
    with pytest.raises(TypeError, match=r"rng must be a numpy\.random\.Generator, got int"):
        make_shape("chair", 3)  # type: ignore[arg-type]


# --- the parts -------------------------------------------------------------------------------------------------------


def _grid() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(0, 3, 4))
    return np.stack([x, y, 0.2 * x**2], 2)


@pytest.mark.parametrize(
    ("part", "volume"),
    [
        (box((2, 3, 1), radius=0.01), 6.0),
        (slab(rectangle(2, 3, 0.01), 0.5, bevel=0.01), 3.0),
        (slab(ellipse(2, 2, 64), 0.5, bevel=0.01), 0.5 * np.pi),
        (post((0, 0, 0), (1, 2, 0), rectangle(1, 1, segments=0), [(0, 1), (1, 1)]), 2.0),
        (revolve([(1, 0), (0.001, 3)], 64), np.pi),
        (revolve([(2, 0), (3, 0), (3, 1), (2, 1)], 64, hollow=True), 5 * np.pi),
        (ellipsoid((2, 4, 6), sides=48, stacks=48), 8 * np.pi),
        (bar((0, 0, 0), (0, 0, 5), 0.5, 0.2), 0.5),
        (tube([(0, 0, 0), (2, 0, 0), (2, 2, 0)], 1.0, rectangle(0.2, 0.2, segments=0)), 0.04 * 4),
        (
            tube([(1, 1, 0), (-1, 1, 0), (-1, -1, 0), (1, -1, 0)], 0.5, rectangle(0.4, 0.4, segments=0), closed=True),
            0.32,
        ),
        (sheet(_grid(), 0.1), 0.1 * 6 * 1.026),
        (wing([(-1, 0, 0, 1, 0.1), (1, 0, 0, 1, 0.1)], points=33), 2 * 0.0725),
    ],
    ids=lambda value: None if isinstance(value, float) else "",
)
def test_parts_are_closed_and_have_the_volume_of_the_formula(part, volume: float) -> None:
    mesh = assemble(part)
    extent = np.ptp(part.lofts[0].rings.reshape(-1, 3), axis=0).max()
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume * extent**3 == pytest.approx(volume, rel=0.03)
    mirrored = assemble(part.scaled(x=-1))
    assert mirrored.volume == pytest.approx(mesh.volume)


def test_rotation_is_right_handed() -> None:
    point = box((0.1, 0.1, 0.1), (1, 0, 0))
    turned = {
        (0, 1, 0): point.rotated("z", 90),
        (0, 0, -1): point.rotated("y", 90),
        (1, 1, -1): point.rotated("x", 90, about=(0, 1, 0)),
    }
    for center, part in turned.items():
        np.testing.assert_allclose(part.lofts[0].rings.mean((0, 1)), center, atol=1e-12)


def test_inset_moves_every_side_by_the_distance() -> None:
    np.testing.assert_allclose(np.ptp(inset(rectangle(2, 1, segments=0), 0.1), axis=0), (1.8, 0.8))


def test_rounded_path_stays_near_the_corner() -> None:
    path = rounded_path([(0, 0, 0), (1, 0, 0), (1, 1, 0)], 0.2)
    assert np.linalg.norm(path - (1, 0, 0), axis=1).min() == pytest.approx(0.05 * np.sqrt(2))
    np.testing.assert_array_equal(path[[0, -1]], [(0, 0, 0), (1, 1, 0)])


def test_thin_bars_do_not_vanish_between_the_rays_of_the_voxeliser() -> None:
    """A slanted rod much thinner than a voxel stays one piece from end to end."""
    voxels = _voxelize(assemble(bar((0, 0, 0), (0.35, 0.98, 0.27), 0.006)))
    assert ndimage.label(voxels, np.ones((3, 3, 3)))[1] == 1
    assert voxels.any((0, 2)).sum() >= 31


def test_pick_follows_the_weights() -> None:
    draw = Draw(np.random.default_rng(0))
    picks = [draw.pick({"a": 3.0, "b": 1.0, "c": 0.0}) for _ in range(2000)]
    assert picks.count("a") == pytest.approx(1500, abs=80)
    assert picks.count("c") == 0
