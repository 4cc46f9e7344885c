"""Tables of poses are matched and refused, and trainings draw from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from runs import same_tensors, stop_and_resume
from steps import TINY, TINY_VPL

from learn3d.config import TrainConfig
from learn3d.data.dataset import ViewDataset
from learn3d.data.layouts import load_dataset
from learn3d.data.pose_table import PoseTable, fingerprints
from learn3d.data.poses import LookAtPoses, PoseCandidates
from learn3d.data.sampling import batches
from learn3d.evaluation import Evaluation, evaluate
from learn3d.files.reading import DamagedFile
from learn3d.methods.plus import Plus
from learn3d.runs import checkpoint, measurement
from learn3d.training import train


def random_table(dataset: ViewDataset, candidates: int = 3) -> PoseTable:
    count, rng = len(dataset), np.random.default_rng(0)
    angles = (
        rng.uniform(low, high, (count, candidates)).astype(np.float32)
        for low, high in ((-180, 180), (0, 40))
    )
    weights = rng.dirichlet(np.ones(candidates), count).astype(np.float32)
    numbers = (np.full(count, value, np.float32) for value in (2.7, 15.0, 0.9))
    return PoseTable(fingerprints(dataset), *angles, weights, *numbers)


def test_a_table_is_read_as_written_and_matched_by_image(
    tmp_path: Path, tiny_set: ViewDataset
) -> None:
    images = np.random.default_rng(0).integers(0, 256, tiny_set.images.shape, np.uint8)
    dataset = dataclasses.replace(tiny_set, images=images)
    random_table(dataset).write(tmp_path / "poses.npz")
    table = PoseTable.read(tmp_path / "poses.npz")
    rows = np.random.default_rng(1).permutation(len(dataset))[:7]
    part = table.apply(dataset.select(rows), "poses.npz")
    assert np.array_equal(part.poses.azimuth_deg, table.azimuth_deg[rows, 0])
    assert np.array_equal(part.candidates.weights, table.weights[rows])
    whole = table.apply(dataset, "poses.npz")
    assert part.view_names == whole.view_names, "a part has the classes of the whole table"
    assert np.array_equal(part.view_ids, whole.view_ids[rows])
    assert np.array_equal(part.candidates.view_ids[::3], part.view_ids), "candidates, too"
    with pytest.raises(
        ValueError, match=r"poses.npz has no pose for 72 of 72 test images .* of object 0000"
    ):
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
    arrays = vars(random_table(tiny_set)) | change
    np.savez(tmp_path / "poses.npz", **{k: a for k, a in arrays.items() if a is not None})
    with pytest.raises(DamagedFile, match=rf"poses.npz: .*{message}"):
        PoseTable.read(tmp_path / "poses.npz")


def test_candidates_are_drawn_by_their_weights(tiny_set: ViewDataset, tiny_config) -> None:
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
    config = tiny_config(Path("."), batch_size=8, iterations=2, augment=())
    assert all((b.poses.azimuth_deg % 2).sum() < 8 for b in batches(dataset, config))


@pytest.fixture
def table(tmp_path: Path, tiny_folder: Path) -> Path:
    """A random table for the splits of the tiny data set."""
    tables = [
        random_table(load_dataset("kato", tiny_folder, "airplane", split))
        for split in ("train", "val")
    ]
    columns = (np.concatenate([getattr(part, name) for part in tables]) for name in vars(tables[0]))
    PoseTable(*columns).write(tmp_path / "poses.npz")
    return tmp_path / "poses.npz"


def test_weights_of_poses_survive_a_stop(
    table: Path, tmp_path: Path, tiny_names: None, tiny_config: Callable[..., TrainConfig]
) -> None:
    """Reweighted after the steps 1 and 3, stopped after step 4."""
    options = {"preset": "plus-kato", "poses": table, "iterations": 6, "pose_updates": 2} | TINY
    assert train(tiny_config(tmp_path / "whole", **options)).finished
    stop_and_resume(tiny_config(tmp_path / "stopped", **options), 4)
    whole, stopped = (
        checkpoint.load(tmp_path / name / "last.safetensors")[0] for name in ("whole", "stopped")
    )
    same_tensors(whole, stopped)
    weights = whole["poses.weights"]
    assert not np.array_equal(weights, PoseTable.read(table).weights[: len(weights)])


def test_a_run_is_measured_with_its_poses_on_its_own_data(
    table: Path,
    run_folder: Path,
    tiny_folder: Path,
    tiny_names: None,
    tiny_config: Callable[..., TrainConfig],
    monkeypatch,
) -> None:
    train(tiny_config(run_folder, preset="plus-kato", iterations=1, poses=table, **TINY))
    measured = []

    def look(method: Plus, dataset: ViewDataset, **options: object) -> Evaluation:
        measured.append(dataset.candidates is not None)
        return evaluate(method, dataset, **options)

    monkeypatch.setattr(measurement, "evaluate", look)
    for data in (None, tiny_folder):
        next(measurement.evaluate_runs([run_folder], data=data, category="airplane", split="val"))
    assert measured == [True, False]


@pytest.mark.parametrize("preset", ["plus-kato", "peng2020-kato", "peng2020-kato-vpl"])
def test_methods_learn_from_a_table(
    preset: str, table: Path, tiny_names, run_folder: Path, tiny_config: Callable[..., TrainConfig]
) -> None:
    networks = TINY_VPL if preset == "peng2020-kato-vpl" else TINY
    config = tiny_config(run_folder, preset=preset, iterations=2, poses=table, **networks)
    assert train(config).finished
