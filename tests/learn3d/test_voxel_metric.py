"""The published metric: axis rule and IoU of Kato's data set, on random grids whose published IoU is known."""

import numpy as np
import torch
from vectors import load_vector

from learn3d.data.conventions import KATO
from nmr.metrics import voxel_iou


def test_iou_after_the_axis_rule_is_the_published_one():
    v = load_vector("voxel_iou")
    predicted, target = (torch.from_numpy(v[name].astype(bool)) for name in ("predicted", "target"))
    np.testing.assert_allclose(voxel_iou(KATO.to_axes(predicted), target).numpy(), v["iou_CVPR18"], rtol=1e-6)
    assert abs(float(voxel_iou(predicted, target)[0]) - v["iou_CVPR18"][0]) > 1e-4  # the rule matters here
