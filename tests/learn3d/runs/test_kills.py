"""Runs that are killed at any moment and resumed end as if nothing had happened.

Two kinds of kills. Those at a place: before a line of the training code that was drawn from all that a run executes,
one of the times that it is executed, or some milliseconds after that from outside; so every phase is hit, however short
it is. And those at a time: a signal from outside after a random part of the run. KILL_SEED=<number> draws others.
"""

from __future__ import annotations

import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from run_server import ENVIRONMENT, RunServer
from runs import check_same

import learn3d
from learn3d import validation
from learn3d.config import TrainConfig
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.training import train

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and SIGKILL")

SEED = int(os.environ.get("KILL_SEED", "0"))
KILLS = 50  # at places
MOST_ATTEMPTS = 100
FUSE, HALF = 0.6, 0.9  # below: killed at the line itself; between: soon after it; above: in the middle of the next file
#: What comes first, so that nothing is left to chance: phases of `run_server`, each hit in a run that has just begun or
#: is resumed from step 0, 3 or 6.
DELIBERATE = (
    ("claim", 0.0),
    ("validate>save", 0.0),
    ("validate>save", 1.0),
    ("save_last>save", 1.0),
    ("load_last>load", 0.0),
    ("draw", 0.0),
    ("save_last>keep_previous", 0.0),
    ("metrics>_write", 0.0),
)
LONGEST_CHAIN = 15  # kills of one run; then it may end
TIMED_SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGKILL, signal.SIGINT) * 3


@pytest.fixture(scope="module")
def server() -> Iterator[RunServer]:
    with RunServer() as server:
        yield server


@pytest.fixture(scope="module")
def killed_config(tiny_folder, tmp_path_factory) -> TrainConfig:
    """10 steps with everything in them: 5 validations, 4 checkpoints, 3 pictures.

    The best networks are those of step 8: a run that forgets them when it is resumed at step 9 takes those of step 10.
    """
    folder = tmp_path_factory.mktemp("killed")
    for path in tiny_folder.iterdir():  # not compressed: the tests read them a hundred times
        with np.load(path) as archive:
            np.savez(folder / path.name, archive["arr_0"])
    small = {"encoder": "conv-small", "generator": "sphere-small", "learning_rate": 1e-2}
    settings = dataclasses.replace(PRESETS["peng2020-kato"].settings, **small)
    often = {"log_every": 1, "validate_every": 2, "checkpoint_every": 3, "pictures_every": 4}
    fixed = {"batch_size": 2, "precision": "fp32", "threads": 1, "max_val_images": 4}
    where = {"data": folder, "category": "airplane", "output": folder / "uninterrupted"}
    return TrainConfig(**where, settings=settings, iterations=10, seed=1, **fixed, **often)


@pytest.fixture(scope="module")
def uninterrupted(server, killed_config) -> tuple[Path, float]:
    """The folder of a run that nothing disturbed, and the seconds it took."""
    started = time.monotonic()
    assert server(killed_config)["status"] == 0  # the server warms up
    started = time.monotonic()
    again = dataclasses.replace(killed_config, output=killed_config.output.with_name("again"))
    assert server(again)["status"] == 0
    check_same(again.output, killed_config.output)
    assert checkpoint.load_metadata(again.output / "best.safetensors")["step"] == 8, "see `killed_config`"
    return killed_config.output, time.monotonic() - started


def check_whole(folder: Path) -> None:
    """What has a name is whole, whenever the run was killed."""
    checkpoints = run_folder.checkpoints(folder)
    assert not checkpoints or checkpoints[0].name == "last.safetensors"
    for path in [*checkpoints, folder / "best.safetensors"]:
        if path.exists():
            checkpoint.load(path)
    if (folder / "config.json").exists():
        json.loads((folder / "config.json").read_text())


def places(server: RunServer, config: TrainConfig) -> dict[str, list[list]]:
    """By phase, every line [phase, module, line, times] that a run or a resumed run executes."""
    whole = server(dataclasses.replace(config, output=config.output.with_name("traced")), trace=True)
    half = dataclasses.replace(config, output=config.output.with_name("resumed"))
    server(dataclasses.replace(half, iterations=6))
    resumed = server(half, resume=True, trace=True)
    found = defaultdict(list)
    for place in sorted(resumed["lines"] + whole["lines"]):
        found[place[0]].append(place)
    return found


def phases(folder: Path, stack: list[str]) -> Iterator[str]:
    """What a killed run was doing, from the functions that were running and from what it left behind."""
    if not (folder / "config.json").exists():
        yield "before config.json"
    elif not (folder / "last.safetensors").exists():
        yield "before the first checkpoint"
    if "save_last" in stack:
        yield "saving the last checkpoint"
    if any(folder.glob(".*.safetensors.partial")):
        yield "between temporary file and name"
    if "validate" in stack:
        yield "validation"
        if "save" in stack:
            yield "saving the best networks"
    if "draw" in stack:
        yield "pictures"
    if "metrics" in stack or "sync" in stack:
        yield "metrics"
    if "load_last" in stack or "restore" in stack:
        yield "resuming"
    if "keep_previous" in stack or "remove_old" in stack:
        yield "keeping earlier checkpoints"
    if "best.safetensors" in (names := {path.name for path in folder.glob("*")}) and "last.safetensors" in names:
        best, last = (checkpoint.load_metadata(folder / f"{name}.safetensors")["step"] for name in ("best", "last"))
        if best > last:
            yield "best networks newer than the last checkpoint"


PHASES = (
    "before config.json",
    "before the first checkpoint",
    "saving the last checkpoint",
    "between temporary file and name",
    "validation",
    "saving the best networks",
    "pictures",
    "metrics",
    "resuming",
    "keeping earlier checkpoints",
    "best networks newer than the last checkpoint",
)


def test_killed_at_any_place(server, killed_config, uninterrupted) -> None:
    reference, _ = uninterrupted
    rng = random.Random(SEED)
    lines = places(server, killed_config)
    assert len(lines) > 20, sorted(lines)
    assert {phase for phase, _ in DELIBERATE} <= set(lines), sorted(lines)
    assert sum(map(len, lines.values())) > 300
    hit: Counter[str] = Counter()
    tried: Counter[str] = Counter()
    kills = attempts = chains = in_chain = 0
    deliberate = list(DELIBERATE)
    config = killed_config
    while attempts < MOST_ATTEMPTS:
        if in_chain == 0:
            chains += 1
            config = dataclasses.replace(config, output=reference.with_name(f"chain{chains}"))
        phase, kind, first = min(lines, key=lambda name: (tried[name], rng.random())), rng.random(), rng.random() < 0.5
        if deliberate:
            (phase, kind), first = deliberate.pop(0), True
        tried[phase] += 1
        *place, times = rng.choice(lines[phase])
        stop = {"at": [*place, 1 if first else rng.randint(1, times)]}
        if FUSE <= kind < HALF:
            stop["fuse"] = rng.uniform(0, 0.03)
        elif kind >= HALF:
            stop["half"] = True
        if in_chain == LONGEST_CHAIN:
            stop = {}
        attempts += 1
        resume = (config.output / "config.json").exists()
        answer = server(config, resume=resume, **stop)
        if answer["status"] == 0:
            check_same(config.output, reference)
            in_chain = 0
            if kills >= KILLS and not set(PHASES) - set(hit):
                break
            continue
        assert answer["status"] == -signal.SIGKILL, config.output.with_suffix(".log").read_text()
        kills, in_chain = kills + 1, in_chain + 1
        check_whole(config.output)
        hit.update(phases(config.output, answer["stack"]))
    print(f"{kills} kills in {attempts} attempts at {chains} runs:", dict(hit))
    assert kills >= KILLS
    assert chains >= 3
    assert not set(PHASES) - set(hit)


def test_signals_at_any_time(server, killed_config, uninterrupted) -> None:
    reference, seconds = uninterrupted
    rng = random.Random(SEED)
    config, chains, statuses = killed_config, 0, []
    for number in [*TIMED_SIGNALS, None]:
        if chains == 0 or statuses[-1] == "finished":
            chains += 1
            config = dataclasses.replace(config, output=reference.with_name(f"timed{chains}"))
        # The first, a SIGKILL, hits for sure, also where the machine has got faster since `seconds` were measured.
        after = rng.uniform(0.05, seconds) if statuses else 0.05
        stop = {"after": after, "signal": number} if number else {}
        answer = server(config, resume=(config.output / "config.json").exists(), **stop)
        check_whole(config.output)
        if answer["status"] < 0:
            assert -answer["status"] == number
            statuses.append("killed")
            continue
        log = config.output.with_suffix(".log").read_text()
        if answer["status"] == 0:
            last = checkpoint.load_metadata(config.output / "last.safetensors")
            statuses.append("finished" if last["step"] == config.iterations else "saved")
        else:  # Python's own answer to SIGINT before the loop begins
            assert (number, "KeyboardInterrupt" in log) == (signal.SIGINT, True), log
            statuses.append("interrupted")
        if statuses[-1] == "finished":
            check_same(config.output, reference)
    print(Counter(statuses))
    assert "killed" in statuses
    assert statuses[-1] == "finished"


def test_a_run_that_was_put_to_sleep_goes_on(server, killed_config, uninterrupted) -> None:
    reference, seconds = uninterrupted
    config = dataclasses.replace(killed_config, output=reference.with_name("asleep"))
    assert server(config, after=seconds / 2, signal=signal.SIGSTOP)["status"] == 0
    check_same(config.output, reference)


def test_the_command_killed_at_any_time(killed_config, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(validation, "PICTURE_ROWS", 8)  # as the command draws them
    reference = dataclasses.replace(killed_config, output=tmp_path / "uninterrupted")
    train(reference)
    names = ("iterations", "seed", "batch_size", "precision", "threads", "max_val_images")
    names += ("log_every", "validate_every", "checkpoint_every", "pictures_every")
    options = [f"--{name.replace('_', '-')}={getattr(killed_config, name)}" for name in names]
    options += ["--encoder=conv-small", "--generator=sphere-small", "--learning-rate=1e-2"]
    options += [f"--data={killed_config.data}", "--category=airplane"]
    run = tmp_path / "run"
    script = [sys.executable, str(Path(__file__).parents[3] / "tools" / "train.py"), f"--output={run}"]
    packages = [str(Path(learn3d.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(packages)}
    rng = random.Random(SEED)
    for lines in (0, 4, 9, None):  # metrics.jsonl has 15
        command = [*script, "--resume"] if (run / "config.json").exists() else [*script, *options]
        with subprocess.Popen(command, stderr=subprocess.PIPE, env=environment, text=True) as process:
            deadline = time.monotonic() + 120
            while lines is not None and process.poll() is None and time.monotonic() < deadline:
                metrics = run / "metrics.jsonl"
                if metrics.exists() and metrics.read_text().count("\n") >= lines:
                    time.sleep(rng.uniform(0, 0.1))
                    process.kill()
                    break
                time.sleep(0.005)
            _, said = process.communicate(timeout=120)
        assert process.returncode in ((0,) if lines is None else (0, -signal.SIGKILL)), said
        if process.returncode == 0:
            break
        check_whole(run)
    check_same(run, reference.output)
