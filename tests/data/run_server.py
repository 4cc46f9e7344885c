"""Starts training runs that can be killed at a chosen place, many a minute: a process that has everything imported.
The networks are those of `tiny_networks`.

It reads one request per line of its standard input, as JSON, and answers with one line each. Every run is a fork of it:
    {"config": {...}, "resume": bool}                     train to the end
    ... "trace": true                                     and answer with the lines of code that were executed
    ... "at": [phase, module, line, time]                 SIGKILL before this line is executed for the time-th time
    ... "at": [...], "fuse": seconds                      SIGKILL from outside so long after that
    ... "at": [...], "half": true                         SIGKILL in the middle of the next checkpoint that is written
    ... "after": seconds, "signal": number                a signal from outside, so long after the start; a SIGSTOP
                                                          is followed by SIGCONT
The answer has "status" (exit status; -9 for SIGKILL), "stack" (functions that were running, innermost first; only with
"at") and "lines" ([phase, module, line, times] each; only with "trace"). A phase is what the training loop called, and
what that called: "save_last>keep_previous".

The process has one thread and OpenMP none of its own, so that a fork finds everything in order.
"""

from __future__ import annotations

import collections
import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

TRACED = ("training", "run_state", "run_folder", "checkpoint", "files", "runlog", "validation")
LIMIT = 120.0  # seconds for a run that nothing kills
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}


class RunServer:
    """The process, seen from a test; use it as a context manager."""

    def __enter__(self) -> RunServer:
        import learn3d

        packages = [str(Path(learn3d.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(packages)}
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._process.stdin.close()
        self._process.wait(timeout=30)
        self._process.stdout.close()

    def __call__(self, config: Any, *, resume: bool = False, **request: Any) -> dict[str, Any]:
        """Carry out one run; see above."""
        from learn3d.config import config_to_dict

        values = {"config": config_to_dict(config), "resume": resume, **request}
        self._process.stdin.write(json.dumps(values) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def serve() -> None:
    """Answer requests until the standard input ends. The first run is made in this process, to import everything."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    warm = False
    for line in sys.stdin:
        request = json.loads(line)
        if not warm:
            with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere:
                with contextlib.redirect_stderr(nowhere):
                    _train(request["config"] | {"output": f"{folder}/run", "iterations": 1}, resume=False)
            warm = True
        answers.write(json.dumps(_fork(request)) + "\n")
        answers.flush()


def _train(config: dict[str, Any], resume: bool) -> None:
    import tiny_networks

    from learn3d import validation
    from learn3d.config import config_from_dict
    from learn3d.training import train

    tiny_networks.put_in_place()
    validation.PICTURE_ROWS = 1
    train(config_from_dict(config), resume=resume)


def _fork(request: dict[str, Any]) -> dict[str, Any]:
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        status = 70
        try:
            os.close(reading)
            log = os.open(Path(request["config"]["output"]).with_suffix(".log"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 2)
            probe = Probe(request, writing)
            probe.install()
            _train(request["config"], request["resume"])
            probe.remove()
            status = 0
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(writing)
    return _watch(process, reading, request)


def _watch(process: int, reading: int, request: dict[str, Any]) -> dict[str, Any]:
    """Wait for the run, send it what was asked for, and put together the answer."""
    end, number = time.monotonic() + LIMIT, signal.SIGKILL
    if "after" in request:
        end, number = time.monotonic() + request["after"], request["signal"]
    received, open_ = b"", True
    while open_:
        ready, _, _ = select.select([reading], [], [], max(0.0, end - time.monotonic()))
        if not ready:
            os.kill(process, number)
            if number == signal.SIGSTOP:
                time.sleep(0.3)
                os.kill(process, signal.SIGCONT)
                number = signal.SIGKILL
            end = time.monotonic() + LIMIT
            continue
        part = os.read(reading, 1 << 16)
        open_, received = bool(part), received + part
        if "fuse" in request and received:
            end = time.monotonic() + request["fuse"]
            request.pop("fuse")
    os.close(reading)
    _, status = os.waitpid(process, 0)
    return {"stack": None} | (json.loads(received) if received else {}) | {"status": os.waitstatus_to_exitcode(status)}


class Probe:
    """Counts the executed lines of the traced modules; at one of them it reports the stack and does what was asked."""

    def __init__(self, request: dict[str, Any], writing: int) -> None:
        self._request, self._writing = request, writing
        self._at = tuple(request["at"]) if "at" in request else None
        self._times: collections.Counter[tuple[str, str, int]] = collections.Counter()

    def install(self) -> None:
        if self._at is not None or self._request.get("trace"):
            sys.settrace(self._on_call)

    def remove(self) -> None:
        sys.settrace(None)
        if self._request.get("trace"):
            self._report({"lines": [[*place, times] for place, times in self._times.items()]})

    def _on_call(self, frame: FrameType, event: str, _: object) -> Any:
        path = Path(frame.f_code.co_filename)
        return self._on_line if path.parent.name == "learn3d" and path.stem in TRACED else None

    def _on_line(self, frame: FrameType, event: str, _: object) -> Any:
        if event == "line":
            stack = _stack(frame)
            place = (">".join(stack[-3::-1][:2]), Path(frame.f_code.co_filename).stem, frame.f_lineno)
            self._times[place] += 1
            if self._at == (*place, self._times[place]):
                sys.settrace(None)
                self._act(stack)
        return self._on_line

    def _act(self, stack: list[str]) -> None:
        self._report({"stack": stack})
        if self._request.get("half"):
            from learn3d.runs import checkpoint

            write = checkpoint._write

            def write_half(path: Path, tensors: Any, metadata: Any) -> None:
                write(path, tensors, metadata)
                os.truncate(path, path.stat().st_size // 2)
                os.kill(os.getpid(), signal.SIGKILL)

            checkpoint._write = write_half
        elif "fuse" not in self._request:
            os.kill(os.getpid(), signal.SIGKILL)

    def _report(self, values: dict[str, Any]) -> None:
        content = json.dumps(values).encode()
        while content:
            content = content[os.write(self._writing, content) :]


def _stack(frame: FrameType | None) -> list[str]:
    """The functions of the package that are running, innermost first; the last are `_train` and `train`."""
    names = []
    while frame is not None:
        if Path(frame.f_code.co_filename).parent.name == "learn3d":
            names.append(frame.f_code.co_name)
        frame = frame.f_back
    return names


if __name__ == "__main__":
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored, also by what is tested
    serve()
