"""Voxel IoUs that need no network: the mean shape, the nearest training object, a random one."""

from __future__ import annotations

import numpy as np
import pytest

from learn3d.commands import main
from learn3d.data.layouts import load_dataset
from learn3d.runs import baselines
from learn3d.runs.baselines import BASELINES, baselines_of_runs, measure_baselines, object_ious
from learn3d.runs.measurement import evaluate_runs


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


def by_definition(train: np.ndarray, measured: np.ndarray) -> list[list[float]]:
    """The three IoUs of each object, by loops."""
    shapes = [train.mean(0) > k / 50 for k in range(50)]
    scores = [np.mean([iou(shape, one) for one in train]) for shape in shapes]
    mean_shape = shapes[int(np.argmax(scores))]
    pairs = [[iou(one, other) for other in train] for one in measured]
    return [
        [iou(mean_shape, one) for one in measured],
        [max(row) for row in pairs],
        [np.mean(row) for row in pairs],
    ]


@pytest.mark.parametrize("block", [1, 3, 512])
def test_baselines_follow_the_definition(block: int, monkeypatch) -> None:
    monkeypatch.setattr(baselines, "_BLOCK", block)
    rng = np.random.default_rng(0)
    density = rng.uniform(0, 1, (1, 4, 4, 4)) ** 2
    train, measured = (rng.random((count, 4, 4, 4)) < density for count in (7, 5))
    found = object_ious(train, measured)
    np.testing.assert_allclose(found, by_definition(train, measured), rtol=1e-12)


def test_known_training_objects_are_found_and_copies_share_their_mean() -> None:
    rng = np.random.default_rng(1)
    train = rng.random((6, 8, 8, 8)) < 0.3
    shape, nearest, random = object_ious(train, train[::-1])
    assert nearest.tolist() == [1] * 6
    assert (random < 0.6).all() and (shape < 1).all()
    copies = np.repeat(train[:1], 4, axis=0)
    assert [ious.tolist() for ious in object_ious(copies, copies[:2])] == [[1, 1]] * 3


def test_baselines_of_a_data_set_are_means_over_images(tiny_folder, finished_run) -> None:
    found = measure_baselines("kato", tiny_folder, "airplane")
    assert [baseline.name for baseline in found] == list(BASELINES)
    train, test = (
        load_dataset("kato", tiny_folder, "airplane", split).voxels for split in ("train", "test")
    )
    assert [baseline.voxel_iou for baseline in found] == pytest.approx(
        np.mean(by_definition(train, test), axis=1)
    )
    (result,) = evaluate_runs([finished_run])
    assert found == baselines_of_runs([finished_run, finished_run]), "once each"
    for baseline in found:
        assert [o[:2] for o in baseline.objects] == [o[:2] for o in result.objects]


def test_objects_count_by_their_images(tiny_folder, monkeypatch) -> None:
    whole = load_dataset("kato", tiny_folder, "airplane", "train")
    uneven = whole.select(np.r_[0:4, 24, 48:50])
    monkeypatch.setattr(
        baselines, "load_dataset", lambda *where: whole if where[3] == "train" else uneven
    )
    found = measure_baselines("kato", tiny_folder, "airplane")
    assert [one.images for one in found[0].objects] == [4, 1, 2]
    ious = by_definition(whole.voxels, whole.voxels)
    wanted = np.average(ious, axis=1, weights=[4, 1, 2])
    assert [baseline.voxel_iou for baseline in found] == pytest.approx(wanted)


def test_evaluate_adds_the_baselines_if_asked(finished_run, monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.argv", ["learn3d"])
    assert main("evaluate", str(finished_run)) == 0
    assert "Mean shape" not in capsys.readouterr().out
    assert main("evaluate", str(finished_run), "--baselines") == 0
    (line,) = [row for row in capsys.readouterr().out.splitlines() if "Mean shape" in row]
    assert f"{baselines_of_runs([finished_run])[0].voxel_iou:.4f}" in line
