"""One run in a process of its own: train as far as it needs, measure, write the result.

The request comes as one line of JSON on the standard input. The parent keeps its end open: when it is gone, for
whatever reason, the worker sees the end of the file and stops as at Ctrl-C, its state saved.
"""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import sys
import threading

from learn3d.config import config_from_dict, config_to_dict
from learn3d.experiments import results
from learn3d.experiments.plan import Run
from learn3d.experiments.state import State, read_state
from learn3d.experiments.tables import Variant
from learn3d.runs.folder import sole_use
from learn3d.training import train

LOCK = ".experiment.lock"  # of a worker, also while it measures; training has its own
STOPPED = 75  # exit status of a run that was stopped and can go on (sysexits' EX_TEMPFAIL)


def request_of(run: Run, *, fresh: bool = False) -> str:
    """The line that asks a worker for a run; `fresh` replaces whatever the folder holds."""
    variant = dataclasses.asdict(run.variant) | {"changes": {}}  # they are in the configuration
    request = {"variant": variant, "category": run.category, "seed": run.seed, "config": config_to_dict(run.config)}
    return json.dumps(request | {"fresh": fresh})


def carry_out(run: Run, *, fresh: bool) -> bool:
    """Train and measure; False when a signal stopped the training. Raises what `train` and `measure` raise."""
    state = State("new") if fresh else read_state(run)
    if state.stage in ("new", "unfinished"):
        (run.folder / results.RESULT_FILE).unlink(missing_ok=True)
        resume = state.stage == "unfinished"
        if not train(run.config, resume=resume, overwrite=not resume).finished:
            return False
    if state.stage != "done":
        record = results.measure(run, check_data=state.stage == "trained")
        print(f"tested: voxel IoU {record['voxel_iou_kato18']:.4f} (kato18)", flush=True)
    return True


def _stop_with_parent() -> None:
    """Interrupt this process when the standard input ends; also where the parent was started with SIGINT ignored, as a
    shell does with what it starts in the background. Here it is the parent's word."""
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def watch() -> None:
        while os.read(0, 4096):  # not sys.stdin, whose lock a thread must not hold when the interpreter ends
            pass
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=watch, daemon=True).start()


def main() -> int:
    request = json.loads(sys.stdin.readline())
    _stop_with_parent()
    config = config_from_dict(request["config"], source="the request")
    run = Run(Variant(**request["variant"]), request["category"], request["seed"], config)
    try:
        with sole_use(run.folder, LOCK):
            return 0 if carry_out(run, fresh=request["fresh"]) else STOPPED
    except (ValueError, OSError, FloatingPointError) as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 1
    except KeyboardInterrupt:  # before or after the training, which saves by itself
        return STOPPED


if __name__ == "__main__":
    sys.exit(main())
