"""A process that has imported everything and makes a fork of itself for each training run that it is asked for.

A run can be killed at the nth thing that it does in its folder (opening, renaming, linking or removing a file), or be
sent a signal after some time. Python's audit events tell what it does, so that no code needs to be changed for it.
Its best networks are those of step `BEST`: what they measure depends on the processor's bits.
"""

from __future__ import annotations

import dataclasses
import faulthandler
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any

from children import environment

from learn3d.config import TrainConfig, config_to_dict

EVENTS = {"open", "os.rename", "os.remove", "os.link", "os.mkdir", "os.rmdir"}
LIMIT = 240.0  # seconds for a run; then it exits with status 1 and its log shows all stacks
BEST = 4  # the last validated step whose networks are called the best


class RunServer:
    """server(config, resume=..., kill_at=n, half=...) or (..., after=seconds, signal=number): how the run ended.

    kill_at: SIGKILL before the nth thing; half: where that gives a file its name, only its first half is written.
    Returns the exit status (negative: the signal) and the number of things that were done.
    """

    def __enter__(self) -> RunServer:
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment(),
            text=True,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.stdin.close()
        self._process.wait(timeout=30)

    def __call__(self, config: TrainConfig, **request: Any) -> dict[str, Any]:
        self._process.stdin.write(json.dumps(request | {"config": config_to_dict(config)}) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def serve() -> None:
    """Answer requests until the standard input ends."""
    import tensorboard.summary  # noqa: F401
    import tiny_networks
    import torch.utils.tensorboard  # noqa: F401

    from learn3d import training
    from learn3d.presets import config_from_dict
    from learn3d.runs.checkpoint import versions

    versions()  # once for all runs, so that a commit made during the tests does not tell them apart
    tiny_networks.put_in_place()
    training.PICTURE_ROWS = 1
    training.validate = partial(_validate, training.validate)
    read, sets = training.load_data, None
    for line in sys.stdin:
        config = config_from_dict(json.loads(line)["config"])
        sets = sets or {
            split: read(config, split) for split in ("train", "val")
        }  # once, and not in every copy
        training.load_data = lambda _, split, sets=sets: sets[split]
        print(json.dumps(_fork(json.loads(line))), flush=True)


def _validate(validate: Callable[..., Any], run: Any, val_set: Any, progress: Any, log: Any) -> Any:
    """Validate as usual, but with the best networks at step `BEST`."""
    known = -1.0 if progress.step <= BEST else 1.0
    found = validate(run, val_set, dataclasses.replace(progress, best_iou=known), log)
    return (
        found if progress.step <= BEST else dataclasses.replace(found, best_iou=progress.best_iou)
    )


def _fork(request: dict[str, Any]) -> dict[str, Any]:
    reading, writing = os.pipe()
    if (process := os.fork()) == 0:
        os.close(reading)
        _run(request, writing)
    os.close(writing)
    if "after" in request:
        time.sleep(request["after"])
        os.kill(process, request["signal"])
    done = os.read(reading, 100)  # empty if the run was killed
    os.close(reading)
    _, status = os.waitpid(process, 0)
    return {"status": os.waitstatus_to_exitcode(status), "done": int(done or 0)}


def _run(request: dict[str, Any], writing: int) -> None:
    from learn3d.presets import config_from_dict
    from learn3d.training import train

    status = 70
    try:
        config = config_from_dict(request["config"])
        log = os.open(config.output.with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 2)
        os.dup2(log, 1)
        faulthandler.dump_traceback_later(LIMIT, exit=True, file=log)
        count = _watch(str(config.output), request.get("kill_at"), request.get("half", False))
        train(config, resume=request.get("resume", False))
        os.write(writing, str(count[0]).encode())
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _watch(folder: str, kill_at: int | None, half: bool) -> list[int]:
    count = [0]

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event not in EVENTS or not isinstance(arguments[0], (str, os.PathLike)):
            return
        if not os.fspath(arguments[0]).startswith(folder):
            return
        count[0] += 1
        if count[0] == kill_at:
            # not a second name of a file
            if half and event == "os.rename" and os.stat(arguments[0]).st_nlink == 1:
                os.truncate(arguments[0], os.stat(arguments[0]).st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    return count


if __name__ == "__main__":
    # under nohup it is ignored, also by what is tested
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    serve()
