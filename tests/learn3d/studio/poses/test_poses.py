"""Poses from masks: azimuths are found or doubted, and drawn."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from darts import darts

import nmr
from learn3d.data.dataset import ViewDataset
from learn3d.data.pose_table import PoseTable, fingerprints
from learn3d.data.readers import kato
from learn3d.methods.pose_updates import SIZE
from learn3d.pictures import HEADER, MARGIN
from learn3d.studio.poses.comparison import compare
from learn3d.studio.poses.estimate import Estimate, _common_frame
from learn3d.studio.poses.neighbours import Masks
from learn3d.studio.poses.options import PoseOptions
from learn3d.studio.poses.prototypes import CandidatePoses
from learn3d.studio.poses.sheet import COLUMNS, PICTURE_SIZE, draw_pose_sheet
from learn3d.studio.poses.turns import _peak_votes, find_turns
from learn3d.studio.poses.views import (
    CameraOptions,
    EstimatedViews,
    estimate_views,
)

QUICK = PoseOptions(steps=25, restarts=1, repeats=1, prototypes=3)


def estimated(dataset: ViewDataset, **options: object) -> EstimatedViews:
    return estimate_views(
        [dataset], CameraOptions(), dataclasses.replace(QUICK, candidates=2, **options)
    )


@pytest.fixture(scope="module")
def found() -> EstimatedViews:
    return estimated(darts(8), steps=40, restarts=2, repeats=2)


def test_azimuths_of_distinct_shapes_are_found(found: EstimatedViews) -> None:
    result = compare(found)
    assert result.accuracy > 0.9 and result.flips < 0.1 and not found.warnings
    assert found.table.weights.shape == (192, 24) and (found.table.weights[:, 2:] == 0).all()
    assert draw_pose_sheet(found).ndim == 3
    alike = dataclasses.replace(found, result=dataclasses.replace(found.result, front_votes=0.5))
    assert "the same from front and back" in alike.warnings[0]


def test_the_frame_is_free_and_turned_for_the_comparison(found: EstimatedViews) -> None:
    """A data set whose azimuths are counted from another side gives the same poses, and another offset."""
    (dataset,), before = found.datasets, compare(found)
    poses = dataclasses.replace(dataset.poses, azimuth_deg=dataset.poses.azimuth_deg + 45)
    after = compare(
        dataclasses.replace(found, datasets=(dataclasses.replace(dataset, poses=poses),))
    )
    assert (after.offset_deg - before.offset_deg) % 360 == 45 and after.accuracy == before.accuracy


def test_a_seed_gives_the_same_bits() -> None:
    dataset, options = darts(5), {"steps": 3}
    first, again, other = (estimated(dataset, seed=seed, **options).table for seed in (0, 0, 1))
    assert all(np.array_equal(getattr(first, name), getattr(again, name)) for name in vars(first))
    assert not np.array_equal(first.weights, other.weights)


def test_ranges_of_elevations_and_unknown_cameras() -> None:
    quick, dataset = dataclasses.replace(QUICK, steps=3, candidates=3), darts(5)
    known = dataclasses.replace(dataset.poses, elevation_deg=20.0 * (torch.arange(120) % 3))
    table = estimate_views(
        [dataclasses.replace(dataset, poses=known)], CameraOptions(), quick
    ).table
    # each azimuth once, at the known elevation
    assert all(len(set(azimuths)) == 24 for azimuths in table.azimuth_deg)
    assert np.array_equal(table.elevation_deg[:, 0], known.elevation_deg)
    views = estimate_views(
        [dataclasses.replace(darts(5), poses=None)], CameraOptions("0:30", 2.5, 31.0), quick
    )
    assert set(np.unique(views.table.elevation_deg)) <= {0.0, 15.0, 30.0}
    assert (views.table.distance == 2.5).all() and (views.table.half_fov_deg == 15.5).all()
    with pytest.raises(
        ValueError, match=r"elevation must be degrees within -90 .. 90, or LOW:HIGH, got '30:x'"
    ):
        CameraOptions("30:x").elevations()
    with pytest.raises(ValueError, match="--compare needs true poses"):
        compare(views)


@pytest.mark.parametrize("turns", [0, 2])
def test_peaks_of_upper_outlines_tell_front_from_back(turns: int) -> None:
    """Two kinds of objects with a fin at the back, one seen from its right and one from its left side each."""
    masks = torch.zeros(4, SIZE, SIZE)
    for mask, height in zip(masks, (4, 4, 8, 8), strict=True):
        mask[16 : 16 + height, 4:28], mask[8:16, 23:27] = 1, 1
    masks[1::2] = masks[1::2].flip(2)
    prototype, azimuth = torch.tensor([0, 0, 1, 1]), torch.tensor([1, 3, 1, 3])
    seen = torch.where(prototype == 1, (azimuth - turns) % 4, azimuth)
    data = Masks(masks.flatten(1), torch.ones(4, 1, dtype=torch.bool), torch.arange(4))
    # the first prototype stays as it is
    votes = _peak_votes(data, prototype, seen, 2, 4)[0, :, 0, 1]
    assert votes.argmax() == turns and votes[2 - turns] < 0


@pytest.mark.parametrize("turns", range(4))
def test_prototypes_are_turned_into_one_frame(turns: int) -> None:
    """Two prototypes for objects of one kind; azimuths of the second are counted from another side."""
    dataset = darts(6)
    masks = torch.from_numpy(dataset.read_masks(np.arange(144))).float() / 255
    masks = torch.nn.functional.avg_pool2d(masks[:, None], 64 // SIZE).flatten(1)
    data = Masks(
        masks, torch.ones(144, 1, dtype=torch.bool), torch.from_numpy(dataset.object_ids).long()
    )
    azimuth, prototype = (dataset.poses.azimuth_deg / 15).round().long() % 24, data.objects % 2
    flipped = 12 * (torch.arange(144) % 3 == 0)
    for wrong in (0, flipped):
        values = torch.ones(144, 2, 24, 1)
        values[torch.arange(144), prototype, (azimuth + wrong - 6 * turns * prototype) % 24] = 0.0
        found, front_votes = find_turns(values, data, torch.Generator().manual_seed(0))
        assert found[0] % 2 == 0 and (found[1] - found[0]) % 4 == turns
        assert (front_votes > 0.9) == (wrong is not flipped)
    assert front_votes < 0.8


def test_independent_estimates_are_turned_into_one_frame() -> None:
    posterior = torch.rand(50, 24, generator=torch.Generator().manual_seed(0)) ** 8
    parts = [posterior.roll(6 * turn, 1) for turn in (0, 1, 3, 2)]
    assert _common_frame(parts, torch.Generator().manual_seed(0)) == [0, 18, 6, 12]


def test_ambiguous_poses_get_low_confidence() -> None:
    """One outline from all sides, too few images, and empty masks."""
    rng, images = np.random.default_rng(0), np.zeros((10, 24, 4, 64, 64), np.uint8)
    for image, (h, w) in zip(images, rng.integers(8, 24, (10, 2)), strict=True):
        image[:, 3, 32 - h : 32 + h, 32 - w : 32 + w] = 255
    views = estimated(kato.from_arrays(images, None, "box", "train"), steps=10)
    assert "do not determine the poses" in views.warnings[0]
    few = darts(1)
    few.images[:4] = 0
    views = estimated(few, steps=3)
    assert views.table.confidence.max() < 0.5 and (views.table.confidence[:4] == 0).all()
    assert (
        views.warnings[0].startswith("4 images have an empty mask")
        and "20 training images" in views.warnings[1]
    )
    few.images[:] = 0
    with pytest.raises(ValueError, match="all training masks are empty"):
        estimated(few)


def test_the_sheet_turns_images_and_prototypes_alike(tiny_set: ViewDataset) -> None:
    count, step = len(tiny_set), PICTURE_SIZE + MARGIN
    azimuth, *others = (np.full((count, 1), value, np.float32) for value in (0, 30, 1))
    azimuth[:, 0] = 30 * (np.arange(count) % 12) - 180
    table = PoseTable(
        fingerprints(tiny_set), azimuth, *others, *np.float32([[2.7], [15], [1]]).repeat(count, 1)
    )
    vertices, faces = nmr.icosphere(1)
    shape = vertices * torch.tensor([0.1, 0.2, 0.4]) * (1 - 0.8 * vertices[:, 2:])
    estimate = Estimate(
        torch.ones(count, 24, 1), torch.ones(count), shape[None], faces, torch.ones(1), 1.0
    )
    candidates = CandidatePoses(torch.arange(24) * 15.0, torch.tensor([30.0]), 2.7, 15.0)
    views = EstimatedViews((tiny_set,), torch.arange(count), candidates, estimate, table)
    before, after = (
        draw_pose_sheet(views, offset)[HEADER:, -COLUMNS * step :] for offset in (0.0, 90.0)
    )
    assert np.array_equal(after, np.roll(before, 3 * step, axis=1))
    assert not np.array_equal(after[:PICTURE_SIZE], before[:PICTURE_SIZE])
