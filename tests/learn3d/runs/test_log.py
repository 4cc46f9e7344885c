"""What a run prints and records."""

from __future__ import annotations

import os

import numpy as np
import pytest

from learn3d.runs.log import RunLog


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
@pytest.mark.parametrize("kind", ["pipe", "link", "dangling link"])
def test_only_plain_files_are_appended_to(tmp_path, kind: str) -> None:
    """A run folder may be a stranger's: a pipe would be waited for, and a link leads to a file of the user's."""
    path, other = tmp_path / "run" / "metrics.jsonl", tmp_path / "other"
    path.parent.mkdir()
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(other)
    if kind == "link":
        other.write_text("mine")
    with pytest.raises(OSError, match=r"metrics.jsonl is no plain file, and nothing is appended to it; move it away"):
        RunLog(path.parent, start=0, total=10)
    assert other.read_text() == "mine" if kind == "link" else not other.exists()


def test_elsewhere_it_prints_few_lines(tmp_path, capsys) -> None:
    with RunLog(tmp_path, start=4, total=100) as log:
        for step in range(5, 101):
            log.step(step, {"projection": 0.25})
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("step 5/100  projection 0.25")
    assert lines[1].startswith("step 100/100")
    assert lines[1].endswith("0:00:00 left")


def test_metrics_can_be_read_back_and_later_ones_are_forgotten(tmp_path, read_metrics) -> None:
    for start in (0, 1):
        with RunLog(tmp_path, start=start, total=9) as log:
            log.metrics(start + 1, "train", {"total": 0.5 + start})
            log.metrics(start + 2, "val", {"voxel_iou": 0.25})
            log.picture(start + 2, "val", np.zeros((4, 4, 3), np.uint8))
    assert [(m["step"], m["split"]) for m in read_metrics(tmp_path)] == [(1, "train"), (2, "train"), (3, "val")]
    assert read_metrics(tmp_path)[1]["total"] == 1.5


@pytest.mark.parametrize("line", ['{"step": 1, "spl', "{}", ""])
def test_damaged_lines_are_dropped(tmp_path, read_metrics, line: str) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"step": 1, "split": "train"}\n' + line)
    with RunLog(tmp_path, start=1, total=2):
        pass
    assert read_metrics(tmp_path) == [{"step": 1, "split": "train"}]


def test_losses_of_steps_that_take_turns_are_shown_as_means(tmp_path, capsys) -> None:
    with RunLog(tmp_path, start=0, total=40) as log:
        for step in range(1, 41):
            turn = {"classification": 3.0} if step % 2 else {"confusion": 1.0}
            log.step(step, {"total": 3.0 if step % 2 else 1.0} | turn)
    last = capsys.readouterr().err.splitlines()[-1]
    assert "total 2  classification 3  confusion 1 " in last
