"""voxelize: published grids, geometry, invariance, bad input."""

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from vectors import load_vector, vector_names

import nmr

VOXELS = vector_names("vox_*")


def test_the_vectors_are_there():
    assert len(VOXELS) >= 8


@pytest.mark.parametrize("name", VOXELS)
def test_published_voxels(name):
    v = load_vector(name)
    voxels = nmr.voxelize(
        torch.from_numpy(v["vertices"]), torch.from_numpy(v["faces"]), int(v["size"]), bool(v["normalize"])
    )
    assert np.array_equal(voxels.numpy(), v["voxels"].astype(bool))


def test_a_box_fills_its_cells_and_axes_keep_their_order():
    corners = torch.tensor([[x, y, z] for x in (0.12, 0.88) for y in (0.32, 0.68) for z in (0.46, 0.56)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    voxels = nmr.voxelize(corners, faces, 20)[0]
    extent = [voxels.any(dim).any(0 if other else -1).sum().item() for dim, other in ((1, 0), (0, 0), (0, 1))]
    assert extent == [16, 8, 3]
    inside = voxels[voxels.any(1).any(1)][:, voxels.any(0).any(1)][:, :, voxels.any(0).any(0)]
    assert inside.all()


def test_a_shape_that_leaves_the_grid_is_hollow():
    vertices, faces = nmr.icosphere(3)
    closed = nmr.voxelize(0.4 * vertices + 0.5, faces)[0]
    opened = nmr.voxelize(0.4 * vertices + torch.tensor([0.2, 0.5, 0.5]), faces)[0]
    assert closed[16, 16, 16] and not opened[6, 16, 16]


def test_same_grid_for_any_number_of_threads_and_batch():
    vertices, faces = nmr.icosphere(2)
    batch = torch.stack([s * vertices + 0.5 for s in (0.1, 0.2, 0.3, 0.4, 0.45)])
    before = torch.get_num_threads()
    try:
        grids = []
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            grids.append(nmr.voxelize(batch, faces))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(grids[0], grids[1]) and torch.equal(grids[0], grids[2])
    assert torch.equal(nmr.voxelize(batch[3], faces)[0], grids[0][3])


@settings(max_examples=150, deadline=None)
@given(
    hnp.arrays(
        np.float32,
        st.tuples(st.integers(1, 2), st.just(6), st.just(3)),
        elements=st.floats(allow_nan=True, allow_infinity=True, width=32) | st.floats(-1, 2, width=32),
    ),
    hnp.arrays(np.int64, st.tuples(st.integers(0, 5), st.just(3)), elements=st.integers(0, 5)),
    st.integers(1, 9),
    st.booleans(),
)
def test_any_mesh_is_voxelized(vertices, faces, size, normalize):
    voxels = nmr.voxelize(torch.from_numpy(vertices), torch.from_numpy(faces), size, normalize)
    assert voxels.dtype == torch.bool and voxels.shape == (len(vertices), size, size, size)
    if len(faces) == 0:
        assert not voxels.any()


@pytest.mark.parametrize(
    "change, error, words",
    [
        (dict(size=0), ValueError, "size must lie in 1"),
        (dict(size=2.5), TypeError, "size must be an integer"),
        (dict(vertices=torch.zeros(3)), ValueError, "vertices must have shape"),
        (dict(faces=torch.full((1, 3), 7)), ValueError, "vertex 7"),
    ],
)
def test_errors(change, error, words):
    good = dict(vertices=torch.zeros(4, 3), faces=torch.zeros(1, 3, dtype=torch.long))
    with pytest.raises(error, match=words):
        nmr.voxelize(**{**good, **change})
