"""Stands in for the training of a table's runs; a module, so that their processes can import it."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from learn3d.config import config_to_dict
from learn3d.distributed.tasks import Task
from learn3d.experiments.plan import Run
from learn3d.files.writing import write_json
from learn3d.runs.folder import CONFIG
from learn3d.terminal import stop_on_signal


def work(run: Run, fresh: bool) -> bool:
    """A category called "fails" fails, "waits" goes on until it is asked to stop, others leave a result whose IoUs
    depend on the variant, the seed and the object."""
    config, name = run.config, run.variant.name
    print("threads", config.threads, "fresh", fresh, flush=True)
    if run.category == "fails":
        print("first line")
        raise ValueError("no such data")
    if run.category == "dies":
        sys.exit(9)
    if run.category == "waits":
        with stop_on_signal() as stop:
            print("waiting", flush=True)
            deadline = time.monotonic() + 60
            while not stop.name and time.monotonic() < deadline:
                time.sleep(0.02)
            print("saved", flush=True)
        return False
    base = {"vanilla": 0.3, "proposed": 0.4}[name] + 0.01 * run.seed
    means = [round(base + 0.02 * k, 5) for k in range(5)]
    table = {"names": list("abcde"), "images": [24] * 5, "defined": [24] * 5, "kato18": means, "kato19": means}
    iou = sum(means) / 5
    result = {"config": config_to_dict(config), "command": "learn3d train ...", "data": str(config.data.resolve())}
    result |= {"checkpoint": run.variant.checkpoint, "seed": run.seed}
    result |= {"iterations": config.iterations, "step": config.iterations, "seconds": 60.0, "fingerprint": {}}
    result |= {"trained_by": {"commit": "0123456789ab"}, "tested_by": {"commit": "ba9876543210"}}
    result |= {"voxel_iou_kato18": iou, "voxel_iou_kato19": iou - 0.05, "mmd": 1 - base, "mmd_paper": 0.5}
    result |= {"images": 120, "chamfer_l1": 0.1, "f_score": 0.6, "undefined": 0, "objects": table, "views": table}
    (run.folder / "test.json").write_text(json.dumps(result))
    write_json(run.folder / CONFIG, config_to_dict(config))
    return True


def never(run: Run, fresh: bool) -> bool:
    """For where nothing may be trained."""
    raise ValueError("started")


def carry_out_here(tasks: Sequence[Task], folder: Path, **how: object) -> dict[str, str]:
    """What the engine does, in this process: starting Python and torch takes seconds."""
    for task in tasks:
        task.log.parent.mkdir(parents=True, exist_ok=True)
        with open(task.log, "a") as log, contextlib.redirect_stdout(log):
            assert task.function(*task.arguments)
    return {}
