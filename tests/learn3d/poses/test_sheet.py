"""The contact sheet of estimated poses, for a table that was turned into another frame."""

from __future__ import annotations

import numpy as np
import torch

import nmr
from learn3d.data.dataset import ViewDataset
from learn3d.data.pose_table import PoseTable, fingerprints
from learn3d.pictures.sheets import HEADER, MARGIN
from learn3d.poses.estimate import Candidates, Estimate
from learn3d.poses.sheet import COLUMNS, TILE, draw_sheet
from learn3d.poses.views import EstimatedViews


def test_images_and_prototypes_are_turned_alike(tiny_set: ViewDataset) -> None:
    count, step = len(tiny_set), TILE + MARGIN
    azimuth, *others = (np.full((count, 1), value, np.float32) for value in (0, 30, 1))
    azimuth[:, 0] = 30 * (np.arange(count) % 12) - 180
    table = PoseTable(fingerprints(tiny_set), azimuth, *others, *np.float32([[2.7], [15], [1]]).repeat(count, 1))
    vertices, faces = nmr.icosphere(1)
    shape = vertices * torch.tensor([0.1, 0.2, 0.4]) * (1 - 0.8 * vertices[:, 2:])
    estimate = Estimate(torch.ones(count, 24, 1), torch.ones(count), shape[None], faces, torch.ones(1), 1.0)
    candidates = Candidates(torch.arange(24) * 15.0, torch.tensor([30.0]), 2.7, 15.0)
    views = EstimatedViews((tiny_set,), torch.arange(count), candidates, estimate, table)
    before, after = (draw_sheet(views, offset)[HEADER:, -COLUMNS * step :] for offset in (0.0, 90.0))
    assert np.array_equal(after, np.roll(before, 3 * step, axis=1))
    assert not np.array_equal(after[:TILE], before[:TILE])
