"""The curves of `learn3d report`: numbers of a run's log, and means by azimuth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("plotly")

from learn3d.files import limits
from learn3d.studio.tables import report


def write_metrics(folder: Path, records: list[object], tail: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "metrics.jsonl").write_text(
        "".join(json.dumps(record) + "\n" for record in records) + tail
    )
    return folder


def records(offset: float, steps: int = 4) -> list[dict]:
    training = [
        {"step": 50 * k, "split": "train", "projection": 1 / k + offset, "total": 2.0}
        for k in range(1, steps)
    ]
    return [*training, {"step": 100, "split": "val", "voxel_iou": 0.5 + offset, "seconds": 3}]


def test_metrics_become_curves(tmp_path) -> None:
    read = report.read_metrics(
        write_metrics(tmp_path / "run", records(0.25), tail='{"step": 200, "spl')
    )
    assert set(read) == {("train", "projection"), ("train", "total"), ("val", "voxel_iou")}
    assert read["train", "projection"] == pytest.approx({50: 1.25, 100: 0.75, 150: 1 / 3 + 0.25})
    titles = [plot["title"] for plot in report.draw_curves([read])]
    assert titles == [
        "voxel IoU, val",
        "projection loss (1 - IoU), train",
        "total loss (weighted), train",
    ]


HOSTILE = [
    "[]",
    "[" * 100_000,
    '{"step": true, "split": "val"}',
    '{"step": 1e300, "split": "val", "a": 1}',
    '{"step": 1, "split": "val", "a": 1' + 400 * "0" + "}",
    "\udcff",
    '{"step": 1, "split": "train", "\\ud800": 1.0}',
    '{"step": 1, "split": "train", "\\u001b[2J": 1.0}',
    json.dumps({"step": 1, "split": "t", "a" * 61: 1.0}),
]


@pytest.mark.parametrize("line", HOSTILE)
def test_hostile_lines_of_a_log_are_left_out(tmp_path, line) -> None:
    path = write_metrics(tmp_path, records(0.25)) / "metrics.jsonl"
    sound, content = report.read_metrics(tmp_path), path.read_bytes()
    path.write_bytes(line.encode("utf-8", "surrogateescape") + b"\n" + content)
    assert report.read_metrics(tmp_path) == sound


def test_large_logs_are_refused(tmp_path, monkeypatch) -> None:
    write_metrics(tmp_path, [{"step": 1, "split": "t"} | {f"n{k}": 1.0 for k in range(101)}])
    with pytest.raises(ValueError, match="holds 101 different numbers"):
        report.read_metrics(tmp_path)
    monkeypatch.setattr(limits, "METRICS_BYTES", 1000)
    with pytest.raises(ValueError, match=r"metrics\.jsonl: has \d+ bytes; the limit is 1000"):
        report.read_metrics(tmp_path)


def test_numbers_of_a_run_have_titles(finished_run) -> None:
    names = {name for _, name in report.read_metrics(finished_run)}
    assert {"voxel_iou", "projection"} <= names <= report.TITLES.keys()


def test_means_by_azimuth_are_those_of_views_or_sectors() -> None:
    azimuths, means = report.mean_by_azimuth(
        np.array([-15.0, 345.0, 359.999, -7.0, 0.0]), np.array([1, 3, 5, 7, np.nan])
    )
    assert azimuths.tolist() == [0.0, 345.0] and means.tolist() == [6.0, 2.0]
