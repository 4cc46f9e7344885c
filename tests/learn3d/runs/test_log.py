"""What a run prints and records."""

from __future__ import annotations

import os

import numpy as np
import pytest

from learn3d.runs.log import RunLog


def test_a_link_is_replaced_and_a_pipe_refused(tmp_path) -> None:
    """A run folder may be a stranger's: a pipe would be waited for, and a link leads to a file of the user's."""
    path, other = tmp_path / "run" / "metrics.jsonl", tmp_path / "other"
    path.parent.mkdir()
    other.write_text("mine")
    path.symlink_to(other)
    with RunLog(path.parent, start=0, total=10) as log:
        log.metrics(1, "train", {"total": 0.5})
    assert other.read_text() == "mine" and not path.is_symlink() and path.stat().st_size
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(OSError, match=r"metrics.jsonl is no plain file"):
        RunLog(path.parent, start=0, total=10)


def test_elsewhere_it_prints_few_lines_with_means_of_losses_that_take_turns(tmp_path, capsys) -> None:
    with RunLog(tmp_path, start=4, total=100) as log:
        for step in range(5, 101):
            log.step(step, {"total": 3.0, "classification": 2.0} if step % 2 else {"total": 1.0, "confusion": 1.0})
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("step 5/100  total 3  classification 2")
    assert lines[1].startswith("step 100/100  total 2  classification 2  confusion 1 ")
    assert lines[1].endswith("0:00:00 left")


@pytest.mark.parametrize("damaged", ["", '{"step": 1, "spl', "{}\n", "[" * 100_000, "\xff\n"])
def test_metrics_can_be_read_back_and_later_or_damaged_ones_are_dropped(tmp_path, read_metrics, damaged: str) -> None:
    for start in (0, 1):
        with RunLog(tmp_path, start=start, total=9) as log:
            log.metrics(start + 1, "train", {"total": 0.5 + start})
            log.metrics(start + 2, "val", {"voxel_iou": 0.25})
            log.picture(start + 2, "val", np.zeros((4, 4, 3), np.uint8))
        with open(tmp_path / "metrics.jsonl", "a", encoding="latin-1") as file:
            file.write(damaged)
    with RunLog(tmp_path, start=3, total=9):
        pass
    assert [(m["step"], m["split"]) for m in read_metrics(tmp_path)] == [(1, "train"), (2, "train"), (3, "val")]
    assert read_metrics(tmp_path)[1]["total"] == 1.5
