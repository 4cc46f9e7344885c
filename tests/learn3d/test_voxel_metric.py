"""The published metric: axis rules and IoU of the data sets, on random grids whose published IoU is known."""

import numpy as np
import pytest
import torch
from vectors import load_vector

from learn3d.data.conventions import KATO
from learn3d.data.readers.kar import KAR
from learn3d.data.readers.pascal3d import PASCAL3D
from learn3d.data.readers.r2n2 import R2N2
from nmr.metrics import voxel_iou

ALL = (KATO, KAR, PASCAL3D, R2N2)


@pytest.mark.parametrize(
    ("convention", "published"), [(KATO, "iou_CVPR18"), (KAR, "iou_NIPS17"), (PASCAL3D, "iou_Pascal3D")]
)
def test_iou_after_the_axis_rule_is_the_published_one(convention, published):
    v = load_vector("voxel_iou")
    predicted, target = (torch.from_numpy(v[name].astype(bool)) for name in ("predicted", "target"))
    np.testing.assert_allclose(voxel_iou(convention.to_axes(predicted), target).numpy(), v[published], rtol=1e-6)
    for other in (voxel_iou(c.to_axes(predicted), target)[0] for c in ALL if c is not convention):
        assert abs(float(other) - v[published][0]) > 1e-4  # the rule matters here


@pytest.mark.parametrize("convention", ALL, ids=lambda convention: convention.name)
def test_stored_axes_and_the_object_frame_are_inverse(convention):
    grid = torch.rand(2, 4, 4, 4, generator=torch.Generator().manual_seed(0)) < 0.5
    assert torch.equal(convention.to_object(convention.to_axes(grid)), grid)


@pytest.mark.parametrize(
    ("convention", "axes"),
    [
        (KATO, [[0, 1, 0], [1, 0, 0], [0, 0, -1]]),
        (KAR, [[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
        (PASCAL3D, [[-1, 0, 0], [0, 0, -1], [0, -1, 0]]),
        (R2N2, [[0, 0, -1], [0, 1, 0], [-1, 0, 0]]),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_axes_are_those_that_are_documented(convention, axes):
    """Row i of `axes` is the axis of the object frame that index i of the stored grid runs along."""
    cell = (3, 1, 2)
    grid = torch.zeros(1, 4, 4, 4, dtype=torch.bool)
    grid[(0, *cell)] = True
    centred = np.array(axes) @ (np.array(cell) - 1.5)
    assert convention.to_axes(grid)[0].nonzero()[0].tolist() == (centred + 1.5).tolist()
