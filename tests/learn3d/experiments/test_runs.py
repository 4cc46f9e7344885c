"""Runs in processes of their own: failing, stopped, resumed, and a real one."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from learn3d.experiments import pool, results, worker
from learn3d.experiments.experiment import Call, run_experiment
from learn3d.experiments.plan import Options, plan_runs
from learn3d.experiments.pool import NOT_FROM_HERE
from learn3d.experiments.tables import TABLES
from learn3d.experiments.worker import carry_out
from learn3d.training import Summary


def test_a_failing_run_does_not_stop_the_others(tmp_path, stub, capsys, options) -> None:
    call = Call("kato", options(categories=("fails", "airplane"), threads=3), jobs=2)
    assert run_experiment(call, worker=stub) == 1
    shown = capsys.readouterr().err
    assert "FAILED fails/vanilla-seed0; the end of its log:" in shown
    assert "error: no such data" in shown
    assert "2 of 4 runs failed" in shown
    report = json.loads((tmp_path / "out" / "kato.json").read_text())
    assert report["missing"] == ["fails/vanilla-seed0", "fails/proposed-seed0"]
    assert report["rows"][0]["cells"]["airplane"]["values"]["kato18"] == pytest.approx(0.34)
    assert report["rows"][0]["cells"]["mean"] == {"paper_printed": 0.357}, "no mean over what is not there"
    assert "threads 3 3" in (tmp_path / "out/runs/airplane/vanilla-seed0/log.txt").read_text()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="POSIX signals")
@pytest.mark.skipif(os.name != "posix", reason="a pipe without a reader ends otherwise there")
def test_runs_go_on_where_nobody_reads_their_progress(tmp_path, stub, monkeypatch, options) -> None:
    for name in ("stdout", "stderr"):
        reading, writing = os.pipe()
        os.close(reading)
        monkeypatch.setattr(sys, name, open(writing, "w"))
    assert run_experiment(Call("kato", options()), worker=stub) == 0
    assert (tmp_path / "out" / "kato.md").is_file()


def test_ctrl_c_stops_all_runs_and_the_next_call_goes_on(tmp_path, stub, capsys, options) -> None:
    call = Call("kato", options(categories=("waits", "airplane")), jobs=2)
    logs = [tmp_path / f"out/runs/waits/{name}-seed0/log.txt" for name in ("vanilla", "proposed")]

    def interrupt() -> None:
        deadline = time.monotonic() + 30
        while not all(log.is_file() and "waiting" in log.read_text() for log in logs) and time.monotonic() < deadline:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    assert run_experiment(call, worker=stub) == 130
    assert all("saved" in log.read_text() for log in logs)
    assert all("own session True" in log.read_text() for log in logs), "else the terminal would interrupt them too"
    assert "stopped; the same command goes on" in capsys.readouterr().err
    assert not (tmp_path / "out/runs/airplane").exists(), "nothing new is started"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals")
@pytest.mark.parametrize(("nohup", "status"), [(True, 0), (False, 130)])
def test_a_closed_terminal_stops_the_runs_except_under_nohup(stub, monkeypatch, nohup, status, options) -> None:
    start = pool._start
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)
    monkeypatch.setattr(pool, "_start", lambda *given: (signal.raise_signal(signal.SIGHUP), start(*given))[1])
    try:
        assert run_experiment(Call("kato", options()), worker=stub) == status
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_real_run_from_training_to_report(tmp_path, tiny_folder, capsys) -> None:
    """Two steps in a worker; then only the measurement; then a refusal to measure it on other data."""
    small = ("precision=fp32", "encoder=conv-small", "generator=sphere-small")
    given = Options(tiny_folder, tmp_path / "out", ("airplane",), ("vanilla",), 2, 4, changes=small, threads=1)
    assert run_experiment(Call("kato", given)) == 0
    folder = tmp_path / "out" / "runs" / "airplane" / "vanilla-seed0"
    result = json.loads((folder / "test.json").read_text())
    assert (result["iterations"], result["step"], result["images"]) == (2, 2, 24)
    assert (result["objects"]["images"], len(result["views"]["names"])) == ([24], 24)
    assert result["objects"]["kato18"][0] == pytest.approx(result["voxel_iou_kato18"], abs=1e-5)
    assert np.mean(result["views"]["kato18"]) == pytest.approx(result["voxel_iou_kato18"], abs=1e-5)
    assert {"chamfer_l1", "f_score", "mmd", "mmd_paper"} <= set(result)

    (folder / "test.json").unlink()
    run = plan_runs(TABLES["kato"], given)[0]
    assert carry_out(run, fresh=False)
    assert json.loads((folder / "test.json").read_text())["voxel_iou_kato18"] == result["voxel_iou_kato18"]
    assert (folder / "log.txt").read_text().count("training: ") == 1, "only measured again"

    np.savez(tmp_path / "02691156_train_images.npz", np.zeros((3, 24, 4, 64, 64), np.uint8))
    shutil.copy(tiny_folder / "02691156_train_voxels.npz", tmp_path)
    moved = dataclasses.replace(run, config=dataclasses.replace(run.config, data=tmp_path))
    with pytest.raises(ValueError, match=r"vanilla-seed0 was trained on other data: the CRC-32 of its 72 training"):
        carry_out(moved, fresh=False)


@pytest.mark.parametrize(
    ("iterations", "fresh", "resume", "overwrite"), [(9, False, True, False), (9, True, False, True)]
)
def test_a_worker_resumes_or_starts_anew(made_by_hand, monkeypatch, iterations, fresh, resume, overwrite) -> None:
    calls = []

    def train(config, **how):
        calls.append(how)
        return Summary(config.output, 5, False, 0.0, 0, 0.0, 0.0)

    monkeypatch.setattr(worker, "train", train)
    monkeypatch.setattr(results, "measure", lambda *_, **__: pytest.fail("a stopped run is not measured"))
    assert not carry_out(made_by_hand(iterations=iterations), fresh=fresh)
    assert calls == [{"resume": resume, "overwrite": overwrite}]


@pytest.mark.parametrize("answer", [signal.SIG_DFL, signal.SIG_IGN], ids=["foreground", "background"])
def test_a_worker_stops_when_its_parent_is_gone(answer: signal.Handlers) -> None:
    code = "import time; from learn3d.experiments import worker; worker._stop_with_parent(); time.sleep(60)"
    process = subprocess.Popen(
        [sys.executable, "-c", NOT_FROM_HERE + code],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, answer),
    )
    process.stdin.close()
    assert b"KeyboardInterrupt" in process.stderr.read()
    assert process.wait(timeout=30) != 0
    process.stderr.close()
