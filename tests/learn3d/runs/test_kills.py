"""Runs that are killed at any moment and resumed end as if nothing had happened. KILL_SEED=<number> draws others."""

from __future__ import annotations

import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from children import environment
from run_server import BEST, RunServer
from runs import check_same

from learn3d import training
from learn3d.config import TrainConfig, config_to_dict
from learn3d.runs import checkpoint
from learn3d.terminal import INTERRUPTED
from learn3d.training import train

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and SIGKILL")

TRAIN = Path(__file__).parents[3] / "tools" / "train.py"
SEED = int(os.environ.get("KILL_SEED", "0"))


@pytest.fixture(scope="module")
def server() -> Iterator[RunServer]:
    with RunServer() as server:
        yield server


@pytest.fixture(scope="module")
def uninterrupted(
    server, tiny_folder, tiny_config, tmp_path_factory
) -> tuple[TrainConfig, float, int]:
    """A run that nothing disturbed, the seconds it took and the number of things it did in its folder.

    It has 10 steps with everything in them: 5 validations, 4 checkpoints, 3 pictures. Its best
    networks are those of step `BEST`; a run that forgets them and is resumed at step 9 takes those
    of step 10.
    """
    folder = tmp_path_factory.mktemp("killed")
    for path in tiny_folder.iterdir():  # not compressed: the tests read them a hundred times
        with np.load(path) as archive:
            np.savez(folder / path.name, archive["arr_0"])
    small = {"generator": "sphere-small", "learning_rate": 1e-2, "batch_size": 2, "threads": 1}
    often = {"validate_every": 2, "checkpoint_every": 3, "pictures_every": 4}
    output = folder / "whole"
    config = tiny_config(output, data=folder, iterations=10, **small, **often)
    started = time.monotonic()
    answer = server(config)
    assert answer["status"] == 0, output.with_suffix(".log").read_text()
    assert checkpoint.load_metadata(output / "best.safetensors").progress.step == BEST
    return config, time.monotonic() - started, answer["done"]


def check_whole(folder: Path) -> None:
    """Every file under its own name is whole, whenever the run was killed."""
    assert (folder / "last.safetensors").exists() or not (folder / "previous.safetensors").exists()
    for path in folder.glob("*.safetensors"):
        checkpoint.load(path)
    if (folder / "config.json").exists():
        json.loads((folder / "config.json").read_text())


@pytest.mark.parametrize("wanted", [6, pytest.param(50, marks=pytest.mark.slow)])
def test_killed_at_any_place(server, uninterrupted, wanted: int) -> None:
    """Chains of three kills: at places that go through a whole run, then twice while it is resumed."""
    killed, _, things = uninterrupted
    rng, kills, chain = random.Random(SEED), 0, 0
    assert things > 60
    while kills < wanted:
        chain += 1
        config = dataclasses.replace(
            killed, output=killed.output.with_name(f"chain{wanted}-{chain}")
        )
        # from the start again where chains were shorter
        first = 1 + (chain - 1) * things * 3 // wanted % things
        for place in (first, rng.randint(1, things // 2), rng.randint(1, things)):
            resume = (config.output / "config.json").exists()
            answer = server(config, resume=resume, kill_at=place, half=rng.random() < 0.5)
            if answer["status"] == 0:  # it had less to do
                break
            assert answer["status"] == -signal.SIGKILL, config.output.with_suffix(
                ".log"
            ).read_text()
            kills += 1
            check_whole(config.output)
        answer = server(config, resume=(config.output / "config.json").exists())
        assert answer["status"] == 0, config.output.with_suffix(".log").read_text()
        check_same(config.output, killed.output)


def test_signals_at_any_time(server, uninterrupted) -> None:
    killed, seconds, _ = uninterrupted
    rng = random.Random(SEED)
    config = dataclasses.replace(killed, output=killed.output.with_name("signals"))
    for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT) * 3:
        stop = {"after": rng.uniform(0.05, seconds), "signal": number}
        status = server(config, resume=(config.output / "config.json").exists(), **stop)["status"]
        check_whole(config.output)
        if status > 0:  # Python's own answer to SIGINT before the loop begins
            assert (
                number == signal.SIGINT
                and "KeyboardInterrupt" in config.output.with_suffix(".log").read_text()
            )
        else:
            assert status in (0, -number)
    assert server(config, resume=(config.output / "config.json").exists())["status"] == 0
    check_same(config.output, killed.output)


@pytest.mark.slow
def test_the_command_interrupted_and_killed_at_any_time(
    uninterrupted, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(training, "PICTURE_ROWS", 8)  # as the command draws them
    # networks of the usual size
    gentle = dataclasses.replace(uninterrupted[0].settings, learning_rate=1e-4)
    reference = dataclasses.replace(
        uninterrupted[0], settings=gentle, output=tmp_path / "uninterrupted"
    )
    train(reference)
    run = tmp_path / "run"
    options = config_to_dict(dataclasses.replace(reference, output=run))
    run.mkdir()
    (run / "config.json").write_text(json.dumps(options))
    command = [sys.executable, TRAIN, "--output", run, "--resume"]
    rng = random.Random(SEED)
    # metrics.jsonl has 15 lines
    for lines, stop in ((0, "SIGKILL"), (1, "SIGINT"), (4, "SIGKILL"), (9, "SIGKILL"), (None, "")):
        with subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment(),
            text=True,
        ) as process:
            deadline = time.monotonic() + 600
            metrics = run / "metrics.jsonl"
            before = metrics.stat().st_mtime_ns if metrics.exists() else 0
            while lines is not None and process.poll() is None and time.monotonic() < deadline:
                written = metrics.exists() and metrics.stat().st_mtime_ns > before
                if written and metrics.read_text().count("\n") >= lines:
                    time.sleep(rng.uniform(0, 0.1))
                    process.send_signal(getattr(signal, stop))
                    break
                time.sleep(0.005)
            out, said = process.communicate(timeout=600)
        if process.returncode == 0:
            assert out.startswith("finished at step 10")
            break
        assert process.returncode == {"SIGKILL": -signal.SIGKILL, "SIGINT": INTERRUPTED}[stop], said
        if stop == "SIGINT":
            assert "stopped by SIGINT" in said and "--resume" in said
            assert out.startswith("stopped at step ")
        check_whole(run)
    check_same(run, reference.output)
