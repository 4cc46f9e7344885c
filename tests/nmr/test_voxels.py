"""voxelize: published grids, the slow definition of kato19, geometry, invariance, bad input."""

import itertools

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import for_threads
from vectors import load_vector, vector_names

import nmr

VOXELS = vector_names("vox_*")
DEFINITIONS = ("kato18", "kato19")


def test_the_vectors_are_there():
    assert len(VOXELS) >= 8


@pytest.mark.parametrize("name", VOXELS)
def test_published_voxels(name):
    v = load_vector(name)
    voxels = nmr.voxelize(
        torch.from_numpy(v["vertices"]),
        torch.from_numpy(v["faces"]),
        int(v["size"]),
        bool(v["normalize"]),
    )
    assert np.array_equal(voxels.numpy(), v["voxels"].astype(bool))


def test_a_box_fills_its_cells_and_axes_keep_their_order():
    corners = torch.tensor(
        [[x, y, z] for x in (0.12, 0.88) for y in (0.32, 0.68) for z in (0.46, 0.56)]
    )
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    voxels = nmr.voxelize(corners, faces, 20)[0]
    extent = [
        voxels.any(dim).any(0 if other else -1).sum().item()
        for dim, other in ((1, 0), (0, 0), (0, 1))
    ]
    assert extent == [16, 8, 3]
    inside = voxels[voxels.any(1).any(1)][:, voxels.any(0).any(1)][:, :, voxels.any(0).any(0)]
    assert inside.all()


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_a_shape_that_leaves_the_grid_is_hollow(definition):
    vertices, faces = nmr.icosphere(3)
    closed = nmr.voxelize(0.4 * vertices + 0.5, faces, definition=definition)[0]
    opened = nmr.voxelize(
        0.4 * vertices + torch.tensor([0.2, 0.5, 0.5]), faces, definition=definition
    )[0]
    assert closed[16, 16, 16] and not opened[6, 16, 16]


@pytest.mark.parametrize("definition", DEFINITIONS)
def test_same_grid_for_any_number_of_threads_and_batch(definition):
    vertices, faces = nmr.icosphere(2)
    batch = torch.stack([s * vertices + 0.5 for s in (0.1, 0.2, 0.3, 0.4, 0.45)])
    grids = for_threads((1, 2, 5), lambda: nmr.voxelize(batch, faces, definition=definition))
    assert torch.equal(grids[0], grids[1]) and torch.equal(grids[0], grids[2])
    assert torch.equal(nmr.voxelize(batch[3], faces, definition=definition)[0], grids[0][3])


def touched_cells(corners, size):
    """Cells that triangles touch, bool [s, s, s]: 13 axes, every cell, in whatever numbers the corners [F, 3, 3] are.

    With integers it is exact: corners are in units of 1/64 cell. Also the least of how far each cell is from the other
    side of its answer, relative to the length of the axis.
    """
    unit = 64 if np.issubdtype(corners.dtype, np.integer) else 1
    grid = np.arange(size + 1) * unit
    boxes = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), -1)
    offsets = list(itertools.product((0, 1), repeat=3))
    eight = np.stack([boxes[x : size + x, y : size + y, z : size + z] for x, y, z in offsets], 3)
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
    outside = np.zeros_like(surface)
    border = np.pad(
        np.zeros([max(n - 2, 0) for n in surface.shape], bool),
        [(1, min(n - 1, 1)) for n in surface.shape],
        constant_values=True,
    )
    outside[border & ~surface] = True
    while True:
        grown = np.pad(outside, 1)
        reached = np.any([np.roll(grown, step, axis) for axis in range(3) for step in (1, -1)], 0)[
            1:-1, 1:-1, 1:-1
        ]
        more = reached & ~surface & ~outside
        if not more.any():
            return ~outside
        outside |= more


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
    corners = torch.tensor(list(itertools.product((0.0, 1.0), repeat=3)))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    thick, thin = (nmr.voxelize(corners, faces, 8, definition=d)[0] for d in ("kato19", "kato18"))
    assert thick.all() and not thin[4, 4, 4]


NOT_NUMBERS = [float("nan"), float("inf"), -float("inf"), 3e38, -1e30, 1e10]


@pytest.mark.parametrize("value", NOT_NUMBERS)
@pytest.mark.parametrize("place", range(9))
def test_kato19_of_a_face_that_is_not_there(value, place):
    vertices = torch.tensor([[0.1, 0.2, 0.3], [0.9, 0.3, 0.4], [0.4, 0.8, 0.9]])
    good = nmr.voxelize(vertices, torch.tensor([[0, 1, 2]]), 16, definition="kato19")
    bad = vertices.clone()
    bad.view(-1)[place] = value
    assert not nmr.voxelize(bad, torch.tensor([[0, 1, 2]]), 16, definition="kato19").any()
    both = torch.cat([bad, vertices])
    grid = nmr.voxelize(both, torch.tensor([[0, 1, 2], [3, 4, 5]]), 16, definition="kato19")
    assert torch.equal(grid, good) and good.any()


def test_kato19_of_a_face_far_larger_than_the_grid():
    """Many grids wide and through its middle: a slab of cells, found without looking at every cell."""
    vertices = torch.tensor([[-900.0, -900.0, 0.3], [900.0, -900.0, 0.3], [0.0, 900.0, 0.3]])
    grid = nmr.voxelize(vertices, torch.tensor([[0, 1, 2]]), 256, definition="kato19")[0]
    assert grid[:, :, 76].all() and grid.sum() == 256 * 256
    tilted = (
        vertices + torch.tensor([0.0, 0.0, 0.2]) + torch.tensor([0.0, 0.0, 1.0]) * vertices[:, :1]
    )
    grid = nmr.voxelize(tilted, torch.tensor([[0, 1, 2]]), 256, definition="kato19")[0]
    assert 256 * 250 > grid.sum(0).bool().sum() > 128 * 250


@settings(max_examples=150, deadline=None)
@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 2), st.just(6), st.just(3)),
        elements=st.floats(allow_nan=True, allow_infinity=True, width=32)
        | st.floats(-1, 2, width=32),
    ),
    hnp.arrays(np.int64, st.tuples(st.integers(0, 5), st.just(3)), elements=st.integers(0, 5)),
    st.integers(1, 9),
    st.booleans(),
    st.sampled_from(DEFINITIONS),
)
def test_any_mesh_is_voxelized(vertices, faces, size, normalize, definition):
    voxels = nmr.voxelize(
        torch.from_numpy(vertices), torch.from_numpy(faces), size, normalize, definition
    )
    assert voxels.dtype == torch.bool and voxels.shape == (len(vertices), size, size, size)
    if len(faces) == 0:
        assert not voxels.any()
