"""Poses from masks: azimuths are found or doubted, tables are matched and refused, training draws from them."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import nmr
from learn3d.config import TrainConfig
from learn3d.data.dataset import Batch, ViewDataset
from learn3d.data.layouts import load_dataset
from learn3d.data.pose_table import PoseTable, fingerprints
from learn3d.data.poses import LookAtPoses, PoseCandidates
from learn3d.data.readers import kato
from learn3d.data.sampling import batches
from learn3d.evaluation import Evaluation, evaluate
from learn3d.experiments import measurement
from learn3d.files.reading import DamagedFile
from learn3d.methods.method import Meshes
from learn3d.methods.plus import Plus
from learn3d.pictures.sheets import HEADER, MARGIN
from learn3d.poses.estimate import SIZE, Candidates, Estimate, Masks, PoseOptions, _common_frame, _peak_votes, _turns
from learn3d.poses.views import (
    COLUMNS,
    TILE,
    CameraOptions,
    EstimatedViews,
    compare,
    draw_sheet,
    estimate_views,
    update_poses,
    update_steps,
)
from learn3d.runs import checkpoint
from learn3d.training import train

QUICK = PoseOptions(steps=25, restarts=1, repeats=1, prototypes=3)


def dart_shapes(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and faces of objects with a thick front and a thin back."""
    sphere, faces = nmr.icosphere(2)
    width = torch.from_numpy(np.random.default_rng(0).uniform(0.9, 1.1, (count, 1, 3))) * torch.tensor([0.3, 0.1, 0.5])
    taper = torch.stack([1 - 0.9 * sphere[:, 2], 1 - 0.9 * sphere[:, 2], torch.ones(len(sphere))], 1)
    return (sphere * taper * width).float(), faces


def darts(objects: int) -> ViewDataset:
    """`dart_shapes` in Kato's 24 views."""
    shapes, faces = dart_shapes(objects)
    images = np.zeros((objects, 24, 4, 64, 64), np.uint8)
    cameras = kato.from_arrays(images[:1], None, "dart", "train").poses.cameras()
    for image, vertices in zip(images, shapes, strict=True):
        drawn = nmr.render_silhouette(vertices.expand(24, -1, -1), faces, cameras, image_size=64)
        image[:, 3] = (255 * drawn).byte().numpy()
    return kato.from_arrays(images, None, "dart", "train")


def estimated(dataset: ViewDataset, **options: object) -> EstimatedViews:
    return estimate_views([dataset], CameraOptions(), dataclasses.replace(QUICK, candidates=2, **options))


@pytest.fixture(scope="module")
def found() -> EstimatedViews:
    return estimated(darts(8), steps=40, restarts=2, repeats=2)


def test_azimuths_of_distinct_shapes_are_found(found: EstimatedViews) -> None:
    result = compare(found)
    assert result.accuracy > 0.9 and result.flips < 0.1 and not found.warnings
    assert found.table.weights.shape == (192, 24) and (found.table.weights[:, 2:] == 0).all()
    assert draw_sheet(found).ndim == 3
    alike = dataclasses.replace(found, result=dataclasses.replace(found.result, front_votes=0.5))
    assert "the same from front and back" in alike.warnings[0]


def test_the_frame_is_free_and_turned_for_the_comparison(found: EstimatedViews) -> None:
    """A data set whose azimuths are counted from another side gives the same poses, and another offset."""
    (dataset,), before = found.datasets, compare(found)
    poses = dataclasses.replace(dataset.poses, azimuth_deg=dataset.poses.azimuth_deg + 45)
    after = compare(dataclasses.replace(found, datasets=(dataclasses.replace(dataset, poses=poses),)))
    assert (after.offset_deg - before.offset_deg) % 360 == 45 and after.accuracy == before.accuracy


def test_a_seed_gives_the_same_bits() -> None:
    dataset, options = darts(5), {"steps": 3}
    first, again, other = (estimated(dataset, seed=seed, **options).table for seed in (0, 0, 1))
    assert all(np.array_equal(getattr(first, name), getattr(again, name)) for name in vars(first))
    assert not np.array_equal(first.weights, other.weights)


def test_ranges_of_elevations_and_unknown_cameras() -> None:
    quick, dataset = dataclasses.replace(QUICK, steps=3, candidates=3), darts(5)
    known = dataclasses.replace(dataset.poses, elevation_deg=20.0 * (torch.arange(120) % 3))
    table = estimate_views([dataclasses.replace(dataset, poses=known)], CameraOptions(), quick).table
    assert all(len(set(azimuths)) == 24 for azimuths in table.azimuth_deg)  # each azimuth once, at the known elevation
    assert np.array_equal(table.elevation_deg[:, 0], known.elevation_deg)
    views = estimate_views([dataclasses.replace(darts(5), poses=None)], CameraOptions("0:30", 2.5, 31.0), quick)
    assert set(np.unique(views.table.elevation_deg)) <= {0.0, 15.0, 30.0}
    assert (views.table.distance == 2.5).all() and (views.table.half_fov_deg == 15.5).all()
    with pytest.raises(ValueError, match=r"elevation must be degrees within -90 .. 90, or LOW:HIGH, got '30:x'"):
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
    votes = _peak_votes(data, prototype, seen, 2, 4)[0, :, 0, 1]  # the first prototype stays as it is
    assert votes.argmax() == turns and votes[2 - turns] < 0


@pytest.mark.parametrize("turns", range(4))
def test_prototypes_are_turned_into_one_frame(turns: int) -> None:
    """Two prototypes for objects of one kind; azimuths of the second are counted from another side."""
    dataset = darts(6)
    masks = torch.from_numpy(dataset.read_masks(np.arange(144))).float() / 255
    masks = torch.nn.functional.avg_pool2d(masks[:, None], 64 // SIZE).flatten(1)
    data = Masks(masks, torch.ones(144, 1, dtype=torch.bool), torch.from_numpy(dataset.object_ids).long())
    azimuth, prototype = (dataset.poses.azimuth_deg / 15).round().long() % 24, data.objects % 2
    flipped = 12 * (torch.arange(144) % 3 == 0)
    for wrong in (0, flipped):
        values = torch.ones(144, 2, 24, 1)
        values[torch.arange(144), prototype, (azimuth + wrong - 6 * turns * prototype) % 24] = 0.0
        found, front_votes = _turns(values, data, torch.Generator().manual_seed(0))
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
    assert views.warnings[0].startswith("4 images have an empty mask") and "20 training images" in views.warnings[1]
    few.images[:] = 0
    with pytest.raises(ValueError, match="all training masks are empty"):
        estimated(few)


def test_the_sheet_turns_images_and_prototypes_alike(tiny_set: ViewDataset) -> None:
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


def random_table(dataset: ViewDataset, candidates: int = 3) -> PoseTable:
    count, rng = len(dataset), np.random.default_rng(0)
    angles = (rng.uniform(low, high, (count, candidates)).astype(np.float32) for low, high in ((-180, 180), (0, 40)))
    weights = rng.dirichlet(np.ones(candidates), count).astype(np.float32)
    numbers = (np.full(count, value, np.float32) for value in (2.7, 15.0, 0.9))
    return PoseTable(fingerprints(dataset), *angles, weights, *numbers)


def test_a_table_is_read_as_written_and_matched_by_image(tmp_path: Path, tiny_set: ViewDataset) -> None:
    images = np.random.default_rng(0).integers(0, 256, tiny_set.images.shape, np.uint8)
    dataset = dataclasses.replace(tiny_set, images=images)
    random_table(dataset).write(tmp_path / "poses.npz")
    table = PoseTable.read(tmp_path / "poses.npz")
    rows = np.random.default_rng(1).permutation(len(dataset))[:7]
    part = table.apply(dataset.select(rows), "poses.npz")
    assert np.array_equal(part.poses.azimuth_deg, table.azimuth_deg[rows, 0])
    assert np.array_equal(part.candidates.weights, table.weights[rows])
    with pytest.raises(ValueError, match=r"poses.npz has no pose for 72 of 72 test images .* of object 0000"):
        table.apply(tiny_set, "poses.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"azimuth_deg": None}, "no item named 'azimuth_deg.npy'.*; expected a table"),
        ({"weights": np.zeros((72, 3), np.float32)}, "must add up to 1"),
        ({"weights": np.full((72, 3), 1 / 3)}, "weights must be float32"),
        ({"distance": np.zeros(72, np.float32)}, "impossible"),
        ({"distance": np.ones(71, np.float32)}, r"distance must be float32 \[72\]"),
        ({"confidence": np.full(72, np.nan, np.float32)}, r"must lie in 0 \.\. 1"),
        ({"confidence": np.full(72, -1, np.float32)}, r"confidence must lie in 0 \.\. 1"),
        ({"azimuth_deg": np.zeros((72, 0), np.float32)}, r"azimuth_deg must be \[N, C\]"),
        ({"distance": np.array([{}] * 72)}, "'distance' must be numbers"),
    ],
)
def test_a_hostile_table_is_refused(
    tmp_path: Path, tiny_set: ViewDataset, change: dict[str, np.ndarray | None], message: str
) -> None:
    arrays = {name: a for name, a in (vars(random_table(tiny_set)) | change).items() if a is not None}
    np.savez(tmp_path / "poses.npz", **arrays)
    with pytest.raises(DamagedFile, match=rf"poses.npz: .*{message}"):
        PoseTable.read(tmp_path / "poses.npz")


def test_candidates_are_drawn_by_their_weights(tiny_set: ViewDataset) -> None:
    """By (seed, step) alone, pose and class together."""
    count = len(tiny_set)
    poses = LookAtPoses(torch.arange(2.0 * count), 30.0, 2.7, 15.0)
    weights = np.tile(np.float32([0.75, 0.25]), (count, 1))
    candidates = PoseCandidates(poses, np.arange(2 * count) % 24, weights, weights)
    dataset = dataclasses.replace(tiny_set, candidates=candidates)
    second = []
    for step in range(200):
        drawn, view_ids = dataset.candidates.draw(torch.arange(count), 0, step)
        assert np.array_equal(view_ids, drawn.azimuth_deg.long() % 24)
        second.append((drawn.azimuth_deg % 2).mean())
    assert abs(np.mean(second) - 0.25) < 0.02
    options = TrainConfig(data=Path("."), category="x", output=Path("."), batch_size=8, iterations=2, augment=())
    assert all((b.poses.azimuth_deg % 2).sum() < 8 for b in batches(dataset, options))


def test_poses_are_found_again_from_the_models_shapes() -> None:
    (vertices, faces), dataset = dart_shapes(6), darts(6)
    poses = LookAtPoses(torch.arange(24.0).repeat(144) * 15, 30.0, 2.732, 15.0)
    weights = np.full((144, 24), 1 / 24, np.float32)
    candidates = PoseCandidates(poses, np.zeros(24 * 144, int), weights, weights.copy())
    dataset = dataclasses.replace(dataset, candidates=candidates)
    batches_of_shapes = iter(vertices.repeat_interleave(24, 0).split(128))
    decode = lambda codes: Meshes(next(batches_of_shapes), faces)  # noqa: E731
    method = SimpleNamespace(in_use=contextlib.nullcontext, encode=torch.Tensor.float, decode=decode)
    changed = update_poses(method, dataset)
    found = torch.from_numpy(weights.argmax(1)) * 15.0
    assert ((found - dataset.poses.azimuth_deg + 180) % 360 - 180).abs().max() == 0
    assert np.allclose(weights.sum(1), 1) and changed == pytest.approx(1 - 1 / 24)
    assert update_steps(1600, 3) == (200, 400, 800) and update_steps(2, 3) == (1,) and update_steps(9, 0) == ()


@pytest.fixture
def table(tmp_path: Path, tiny_folder: Path) -> Path:
    """A random table for the splits of the tiny data set."""
    tables = [random_table(load_dataset("kato", tiny_folder, "airplane", split)) for split in ("train", "val")]
    columns = (np.concatenate([getattr(part, name) for part in tables]) for name in vars(tables[0]))
    PoseTable(*columns).write(tmp_path / "poses.npz")
    return tmp_path / "poses.npz"


def test_weights_of_poses_survive_a_stop(
    table: Path, tmp_path: Path, tiny_config: Callable[..., TrainConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reweighted after the steps 1 and 3, stopped after step 4."""
    options = {"preset": "plus-kato", "poses": table, "iterations": 6, "pose_updates": 2}
    assert train(tiny_config(tmp_path / "whole", **options)).finished
    step_of = Plus.take_step

    def stop(method: Plus, batch: Batch, step: int) -> dict[str, float]:
        if step == 4:
            signal.raise_signal(signal.SIGINT)
        return step_of(method, batch, step)

    with monkeypatch.context() as patch:
        patch.setattr(Plus, "take_step", stop)
        assert not train(tiny_config(tmp_path / "stopped", **options)).finished
    assert train(tiny_config(tmp_path / "stopped", **options), resume=True).finished
    whole, stopped = (checkpoint.load(tmp_path / name / "last.safetensors")[0] for name in ("whole", "stopped"))
    assert whole.keys() == stopped.keys()
    assert all(torch.equal(whole[name], stopped[name]) for name in whole)
    weights = whole["poses.weights"]
    assert not np.array_equal(weights, PoseTable.read(table).weights[: len(weights)])


def test_a_run_is_measured_with_its_poses_on_its_own_data(
    table: Path, run_folder: Path, tiny_folder: Path, tiny_config: Callable[..., TrainConfig], monkeypatch
) -> None:
    train(tiny_config(run_folder, preset="plus-kato", iterations=1, poses=table))
    measured = []

    def look(method: Plus, dataset: ViewDataset, **options: object) -> Evaluation:
        measured.append(dataset.candidates is not None)
        return evaluate(method, dataset, **options)

    monkeypatch.setattr(measurement, "evaluate", look)
    for data in (None, tiny_folder):
        measurement.evaluate_runs([run_folder], data=data, category="airplane", split="val")
    assert measured == [True, False]


@pytest.mark.parametrize("preset", ["plus-kato", "peng2020-kato", "peng2020-kato-vanilla", "peng2020-kato-vpl"])
def test_methods_learn_from_a_table(
    preset: str, table: Path, run_folder: Path, tiny_config: Callable[..., TrainConfig]
) -> None:
    assert train(tiny_config(run_folder, preset=preset, iterations=2, poses=table)).finished
