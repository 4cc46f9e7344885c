"""Runs in processes of their own: failing, stopped, resumed, and a real one."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
import pytest
import stub_work

from learn3d.distributed import tasks
from learn3d.experiments import experiment
from learn3d.experiments.experiment import run_experiment, train_and_test
from learn3d.experiments.plan import Request, plan_runs
from learn3d.runs.summary import Summary


def test_a_failing_run_does_not_stop_the_others(tmp_path, capsys, request_for) -> None:
    call = request_for(category="fails,airplane", methods=("vanilla",), threads=3, jobs=2)
    assert run_experiment(call, work=stub_work.work) == 1
    shown = capsys.readouterr().err
    assert "FAILED fails/vanilla-seed0; the end of its log:" in shown
    assert "error: no such data" in shown
    assert "1 of 2 runs failed" in shown
    report = json.loads((tmp_path / "out" / "kato.json").read_text())
    assert report["missing"] == ["fails/vanilla-seed0"]
    assert report["rows"][0]["cells"]["airplane"]["values"]["kato18"] == pytest.approx(0.34)
    assert report["rows"][0]["cells"]["mean"] == {"paper_printed": 0.357}, "no mean over what is not there"
    assert "threads 3 " in (tmp_path / "out/runs/airplane/vanilla-seed0/log.txt").read_text()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="POSIX signals")
@pytest.mark.skipif(os.name != "posix", reason="a pipe without a reader ends otherwise there")
def test_runs_go_on_where_nobody_reads_their_progress(tmp_path, monkeypatch, request_for) -> None:
    for name in ("stdout", "stderr"):
        reading, writing = os.pipe()
        os.close(reading)
        monkeypatch.setattr(sys, name, open(writing, "w"))
    assert run_experiment(request_for(methods=("vanilla",)), work=stub_work.work) == 0
    assert (tmp_path / "out" / "kato.md").is_file()


def test_ctrl_c_stops_all_runs_and_the_next_call_goes_on(tmp_path, capsys, request_for) -> None:
    call = request_for(category="waits,airplane", jobs=2)
    logs = [tmp_path / f"out/runs/waits/{name}-seed0/log.txt" for name in ("vanilla", "proposed")]

    def interrupt() -> None:
        for log in logs:
            wait_for("waiting", log)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    assert run_experiment(call, work=stub_work.work) == 130
    assert all("saved" in log.read_text() for log in logs)
    assert "stopped; the same command goes on" in capsys.readouterr().err
    assert not (tmp_path / "out/runs/airplane").exists(), "nothing new is started"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals")
@pytest.mark.parametrize(("nohup", "status"), [(True, 0), (False, 130)])
def test_a_closed_terminal_stops_the_runs_except_under_nohup(monkeypatch, nohup, status, request_for) -> None:
    executor = tasks._executor

    @contextlib.contextmanager
    def hang_up(*given: object) -> Iterator[Executor]:
        with executor(*given) as threads:
            signal.raise_signal(signal.SIGHUP)
            yield threads

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)
    monkeypatch.setattr(tasks, "_executor", hang_up)
    try:
        assert run_experiment(request_for(methods=("vanilla",)), work=stub_work.work) == status
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_real_run_from_training_to_report(tmp_path, tiny_folder, capsys) -> None:
    """Two steps in a worker; then only the measurement; then a refusal to measure it on other data."""
    small = ("precision=fp32", "encoder=conv-small", "generator=sphere-small")
    given = Request("kato", tiny_folder, tmp_path / "out", "airplane", ("vanilla",), 2, 4, set=small, threads=1)
    assert run_experiment(given) == 0
    folder = tmp_path / "out" / "runs" / "airplane" / "vanilla-seed0"
    result = json.loads((folder / "test.json").read_text())
    assert (result["iterations"], result["step"], result["images"]) == (2, 2, 24)
    assert (result["objects"]["images"], len(result["views"]["names"])) == ([24], 24)
    assert result["objects"]["kato18"][0] == pytest.approx(result["voxel_iou_kato18"], abs=1e-5)
    assert np.mean(result["views"]["kato18"]) == pytest.approx(result["voxel_iou_kato18"], abs=1e-5)
    assert {"chamfer_l1", "f_score", "mmd", "mmd_paper"} <= set(result)

    (folder / "test.json").unlink()
    run = plan_runs(given)[0]
    assert train_and_test(run, fresh=False)
    assert json.loads((folder / "test.json").read_text())["voxel_iou_kato18"] == result["voxel_iou_kato18"]
    assert (folder / "log.txt").read_text().count("training: ") == 1, "only measured again"

    np.savez(tmp_path / "02691156_train_images.npz", np.full((3, 24, 4, 64, 64), 200, np.uint8))
    for name in ("train_voxels", "val_images", "val_voxels"):
        shutil.copy(tiny_folder / f"02691156_{name}.npz", tmp_path)
    moved = dataclasses.replace(run, config=dataclasses.replace(run.config, data=tmp_path))
    with pytest.raises(ValueError, match="other training data"):
        train_and_test(moved, fresh=False)


def test_a_run_goes_on_or_starts_anew(finished_run, tiny_folder, request_for, tmp_path, monkeypatch) -> None:
    (tmp_path / "out/runs/airplane").mkdir(parents=True)
    shutil.copytree(finished_run, tmp_path / "out/runs/airplane/proposed-seed0")
    small = ("precision=fp32", "encoder=conv-small", "generator=sphere-small")
    given = dataclasses.replace(request_for(methods=("proposed",), iterations=9, set=small), data=tiny_folder)
    (run,) = plan_runs(given)
    calls = []

    def train(config, **how):
        calls.append(how)
        return Summary(config.output, 5, False, 0.0, 0, 0.0, 0.0)

    monkeypatch.setattr(experiment, "train", train)
    monkeypatch.setattr(experiment, "measure", lambda *_, **__: pytest.fail("a stopped run is not measured"))
    assert not train_and_test(run, fresh=False)
    assert not train_and_test(run, fresh=True)
    (run.folder / "config.json").unlink()
    assert not train_and_test(run, fresh=False), "a checkpoint alone is a run, too"
    shutil.rmtree(run.folder)
    assert not train_and_test(run, fresh=False)
    goes_on, new = {"resume": True, "overwrite": False}, {"resume": False, "overwrite": True}
    assert calls == [goes_on, new, goes_on, new]


def test_a_run_that_dies_is_a_failed_one(capsys, request_for) -> None:
    assert run_experiment(request_for(category="dies", methods=("vanilla",)), work=stub_work.work) == 1
    assert "FAILED dies/vanilla-seed0" in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_runs_stop_when_their_parent_is_gone(tmp_path) -> None:
    code = f"""
import sys
sys.path[:0] = {sys.path!r}
from pathlib import Path
import stub_work
from learn3d.experiments.experiment import run_experiment
from learn3d.experiments.plan import Request
if __name__ == "__main__":
    given = Request("kato", Path("data"), Path({str(tmp_path)!r}), "waits", ("vanilla",), 6, 4, threads=1)
    run_experiment(given, work=stub_work.work)
"""
    (tmp_path / "parent.py").write_text(code)
    log = tmp_path / "runs/waits/vanilla-seed0/log.txt"
    with subprocess.Popen([sys.executable, tmp_path / "parent.py"], stderr=subprocess.DEVNULL) as parent:
        wait_for("waiting", log)
        parent.kill()
    wait_for("saved", log)


def wait_for(text: str, log: Path) -> None:
    deadline = time.monotonic() + 30
    while not (log.is_file() and text in log.read_text()):
        assert time.monotonic() < deadline, f"no {text!r} in {log}"
        time.sleep(0.05)
