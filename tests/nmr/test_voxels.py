"""voxelize: published grids, the slow definition of kato19, geometry, invariance, bad input."""

import itertools

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from vectors import load_vector, vector_names

import nmr

VOXELS = vector_names("vox_*")
DEFINITIONS = ("kato18", "kato19")


def test_the_vectors_are_there():
    assert len(VOXELS) >= 8


@pytest.mark.parametrize("name", VOXELS)
def test_published_voxels(name):
    v = load_vector(name)
    vertices, faces = torch.from_numpy(v["vertices"]), torch.from_numpy(v["faces"])
    voxels = nmr.voxelize(vertices, faces, int(v["size"]), bool(v["normalize"]))
    assert np.array_equal(voxels.numpy(), v["voxels"].astype(bool))


def box(*sides):
    """A box from pairs (low, high): vertices, faces."""
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return torch.cartesian_prod(*map(torch.tensor, sides)), torch.tensor(faces)


def test_a_box_fills_its_cells_and_axes_keep_their_order():
    voxels = nmr.voxelize(*box((0.12, 0.88), (0.32, 0.68), (0.46, 0.56)), 20)[0]
    cells = voxels.nonzero()
    extent = cells.amax(0) - cells.amin(0) + 1
    assert extent.tolist() == [16, 8, 3] and len(cells) == 16 * 8 * 3


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_a_shape_that_leaves_the_grid_is_hollow(definition):
    vertices, faces = nmr.icosphere(3)
    for x, filled in ((0.5, True), (0.2, False)):
        placed = 0.4 * vertices + torch.tensor([x, 0.5, 0.5])
        grid = nmr.voxelize(placed, faces, definition=definition)[0]
        assert grid[int(32 * x), 16, 16] == filled


def touched_cells(corners, size):
    """Cells that triangles touch, bool [s, s, s]: 13 axes, every cell, in whatever numbers the corners [F, 3, 3] are.

    With integers it is exact: corners are in units of 1/64 cell. Also the least of how far each cell is from the other
    side of its answer, relative to the length of the axis.
    """
    unit = 64 if np.issubdtype(corners.dtype, np.integer) else 1
    first = np.stack(np.indices((size,) * 3), -1)[..., None, :]
    eight = (first + list(itertools.product((0, 1), repeat=3))) * unit
    touched, margin = np.zeros((size,) * 3, bool), np.full((size,) * 3, np.inf)
    for a, b, c in corners:
        sides = (b - a, c - b, a - c)
        axes = [*np.eye(3, dtype=corners.dtype), np.cross(sides[0], sides[1])]
        axes += [np.cross(axis, side) for axis in axes[:3] for side in sides]
        gap = np.full((size,) * 3, -np.inf)  # > 0: separated
        for axis in axes:
            of_box, of_face = eight @ axis, np.stack([a, b, c]) @ axis
            between = np.maximum(of_box.min(-1) - of_face.max(), of_face.min() - of_box.max(-1))
            gap = np.maximum(gap, between / max(np.linalg.norm(axis.astype(float)), 1e-30))
        touched |= gap <= 0
        margin = np.minimum(margin, np.abs(gap))
    return touched, margin


def fill(surface):
    """All that is not reached from the border through faces of cells off the surface."""
    open_cells = np.pad(~surface, 1, constant_values=True)
    outside = np.zeros_like(open_cells)
    outside[0, 0, 0] = True
    while True:
        steps = [np.roll(outside, step, axis) for axis in range(3) for step in (1, -1)]
        grown = np.any([outside, *steps], 0) & open_cells
        if np.array_equal(grown, outside):
            return ~outside[1:-1, 1:-1, 1:-1]
        outside = grown


def kato19(vertices, faces, size):
    return nmr.voxelize(
        torch.as_tensor(vertices), torch.as_tensor(faces), size, definition="kato19"
    )[0].numpy()


# Coordinates in 1/64 of a cell, on whole cells more often than not, some outside of the grid.
whole = st.integers(-1, 9).map(lambda n: 64 * n)
corners = hnp.arrays(np.int64, (6, 3), elements=whole | st.integers(-64, 9 * 64))
triples = hnp.arrays(np.int64, st.tuples(st.integers(0, 5), st.just(3)), elements=st.integers(0, 5))
sizes = st.sampled_from([1, 2, 4, 8])  # powers of two: coordinates in [0, 1] times s are exact


@settings(max_examples=80, deadline=None)
@given(corners, triples, sizes)
def test_kato19_is_its_slow_definition_where_touching_is_exact(corners, faces, size):
    surface, _ = touched_cells(corners[faces], size)
    assert np.array_equal(kato19(corners / (64.0 * size), faces, size), fill(surface))


@pytest.mark.parametrize("seed", range(6))
def test_kato19_is_its_slow_definition_elsewhere(seed):
    rng = np.random.default_rng(seed)
    size, faces = 7, np.arange(3).reshape(1, 3)
    for scale in (0.05, 0.3, 2.0):
        vertices = (rng.random((1, 3)) + scale * rng.standard_normal((3, 3))).astype(np.float32)
        surface, margin = touched_cells(
            (vertices * np.float32(size)).astype(np.float64)[faces], size
        )
        assert margin.min() > 1e-9  # no cell is a matter of rounding
        assert np.array_equal(kato19(vertices, faces, size), fill(surface))


def test_a_box_that_fills_the_grid_is_open_in_kato18():
    whole = box(*[(0.0, 1.0)] * 3)
    thin, thick = (nmr.voxelize(*whole, 8, definition=d)[0] for d in DEFINITIONS)
    assert thick.all() and not thin[4, 4, 4]


NOT_NUMBERS = [float("nan"), float("inf"), -float("inf"), 3e38, -1e30, 1e10]


@pytest.mark.parametrize("value", NOT_NUMBERS)
@pytest.mark.parametrize("place", range(9))
def test_kato19_of_a_face_that_is_not_there(value, place):
    vertices, face = np.float32([[0.1, 0.2, 0.3], [0.9, 0.3, 0.4], [0.4, 0.8, 0.9]]), [[0, 1, 2]]
    bad = vertices.copy()
    bad.flat[place] = value
    assert not kato19(bad, face, 16).any()
    good, both = kato19(vertices, face, 16), np.concatenate([bad, vertices])
    assert np.array_equal(kato19(both, [[0, 1, 2], [3, 4, 5]], 16), good) and good.any()


def test_kato19_of_a_face_far_larger_than_the_grid():
    """Many grids wide and through its middle: a slab of cells, found without looking at every cell."""
    vertices = np.float32([[-900, -900, 0.3], [900, -900, 0.3], [0, 900, 0.3]])
    grid = kato19(vertices, [[0, 1, 2]], 256)
    assert grid[:, :, 76].all() and grid.sum() == 256 * 256
    vertices[:, 2] += 0.2 + vertices[:, 0]  # tilted
    assert 256 * 250 > kato19(vertices, [[0, 1, 2]], 256).any(0).sum() > 128 * 250


def test_a_mesh_that_is_not_finite_can_be_normalized():
    vertices, faces = np.full((1, 3, 3), np.nan, np.float32), [[0, 1, 2]]
    for definition in DEFINITIONS:
        voxels = nmr.voxelize(torch.from_numpy(vertices), torch.tensor(faces), 4, True, definition)
        assert voxels.shape == (1, 4, 4, 4) and voxels.dtype == torch.bool
