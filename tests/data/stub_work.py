"""Stands in for the training of a table's runs, and for tasks; a module, so that their processes can import it."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from typing import Any

from learn3d.config import config_to_dict
from learn3d.files.writing import write_json
from learn3d.runs.folder import CONFIG
from learn3d.runs.measurement import CurvePoint, ObjectMeans, Result
from learn3d.studio.tables.plan import PlannedRun
from learn3d.tasks import Task, Workers
from learn3d.terminal import stop_on_signal


def result(**changes: Any) -> Result:
    """The measurement of a run."""
    numbers = {
        "precision": 0.5,
        "recall": 0.5,
        "chamfer_l1": 0.1,
        "f_score": 0.6,
        "mmd": 0.7,
        "mmd_paper": 0.5,
    }
    numbers |= {
        "voxel_iou": 0.5,
        "voxel_iou_kato19": 0.4,
        "silhouette_iou": None,
        "hollow": 0.0,
        "seconds": 60.0,
    }
    counts = {"images": 120, "iterations": 6, "step": 6, "seed": 0}
    texts = {"checkpoint": "run/last.safetensors", "method": "Proposed", "preset": "peng2020-kato"}
    texts |= {"category": "airplane", "data": "/data", "command": "learn3d train ..."}
    objects = [ObjectMeans(name, 24, 0.5, 0.4) for name in "abcde"]
    lists = {"versions": {"commit": "0123456789ab"}, "objects": objects}
    lists["curve"] = [CurvePoint("val", 3, 0.2, None)]
    return Result(**(numbers | counts | texts | lists | changes))


def work(run: PlannedRun) -> bool:
    """A category called "fails" fails, "waits" goes on until it is asked to stop; others leave a result whose IoUs
    depend on the variant, the seed and the object."""
    config = run.config
    print("threads", config.threads, flush=True)
    if config.category == "fails":
        print("first line")
        raise ValueError("no such data")
    if config.category == "dies":
        sys.exit(9)
    if config.category == "waits":
        with stop_on_signal() as stop:
            print("waiting", flush=True)
            deadline = time.monotonic() + 60
            while not stop.name and time.monotonic() < deadline:
                time.sleep(0.02)
            print("saved", flush=True)
        return False
    base = {"vanilla": 0.3, "proposed": 0.4}[run.variant] + 0.01 * config.seed
    means = [round(base + 0.02 * k, 5) for k in range(5)]
    iou = sum(means) / 5
    measured = result(
        data=str(config.data.resolve()),
        iterations=config.iterations,
        step=config.iterations,
        seed=config.seed,
        voxel_iou=iou,
        voxel_iou_kato19=iou - 0.05,
        mmd=1 - base,
        objects=[
            ObjectMeans(name, 24, mean, mean) for name, mean in zip("abcde", means, strict=True)
        ],
    )
    write_json(config.output / "test.json", measured.model_dump())
    write_json(config.output / CONFIG, config_to_dict(config))
    return True


def fail_if_started(run: PlannedRun) -> bool:
    """Replaces `work` if nothing may be trained."""
    raise ValueError("started")


def run_tasks_here(tasks: Sequence[Task], workers: Workers) -> list[str]:
    """Run tasks in this process: starting Python and torch takes seconds."""
    for task in tasks:
        task.log.parent.mkdir(parents=True, exist_ok=True)
        with (
            open(task.log, "a") as log,
            contextlib.redirect_stdout(log),
            contextlib.redirect_stderr(log),
        ):
            assert task.function(*task.arguments)
    return []
