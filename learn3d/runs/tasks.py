"""Runs tasks, each in its own process, a few at a time.

A task is a function call that writes files and continues from them when it is called again. So an interrupted
`run_tasks` is resumed by the same call.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learn3d.terminal import INTERRUPTED, note, stop_on_signal, without_traceback

TAIL_LINES = 5  # lines of a failed task's log that are shown
_CHILD = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
_CHILD += "from learn3d.runs import tasks; sys.exit(tasks._child())"


@dataclass(frozen=True)
class Task:
    """A function call in its own process."""

    name: str  # for messages
    function: Callable[..., bool]  # importable; returns False if SIGTERM stopped it and it can be resumed
    arguments: tuple[Any, ...]
    log: Path  # file to which its output is appended


def run_tasks(tasks: Sequence[Task], *, jobs: int = 1) -> dict[str, str]:
    """Run `tasks`, at most `jobs` at a time; return the end of the log of every failed task, by the task's name.

    A failing task does not stop the others. After SIGINT, SIGTERM or SIGHUP no task is started, and each running one
    saves its state and ends.
    """
    failed: dict[str, str] = {}
    stop = threading.Event()
    with stop_on_signal() as asked, concurrent.futures.ThreadPoolExecutor(jobs) as executor:
        waiting = {executor.submit(_run_in_process, task, stop): task for task in tasks}
        try:
            while waiting:
                ended, _ = concurrent.futures.wait(waiting, 0.1, concurrent.futures.FIRST_COMPLETED)
                if asked.name and not stop.is_set():
                    note("stopping: running tasks save their state")
                    stop.set()
                for future in ended:
                    task = waiting.pop(future)
                    status, tail = _outcome(task, future)
                    if status not in (0, INTERRUPTED) and not asked.name:
                        failed[task.name] = tail
                    if not asked.name:
                        end = "failed" if task.name in failed else "stopped" if status else "done"
                        note(f"[{len(tasks) - len(waiting)}/{len(tasks)}] {task.name}: {end}; {tail.splitlines()[-1]}")
        finally:
            stop.set()  # after an error, too, no task continues in the background
    return failed


def _run_in_process(task: Task, stop: threading.Event) -> int:
    """Run a task in a new process; returns its exit status."""
    if stop.is_set():
        return INTERRUPTED
    task.log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", _CHILD]
    with (
        open(task.log, "ab") as output,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output) as process,
    ):
        with contextlib.suppress(OSError):  # the process has already ended
            process.stdin.write(pickle.dumps(sys.path) + pickle.dumps(task))
            process.stdin.flush()
        while process.poll() is None and not stop.is_set():
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(0.2)
        process.terminate()  # not SIGINT: Ctrl-C has sent it already, and a second one would end the task at once
        return process.wait()


@without_traceback
def _child() -> int:
    """The main function of a task's process."""
    task = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    return 0 if task.function(*task.arguments) else INTERRUPTED


def _stop_with_parent() -> None:
    """Send SIGTERM to this process when its parent has ended for any reason."""
    os.read(sys.stdin.fileno(), 1)  # returns when the pipe is closed
    os.kill(os.getpid(), signal.SIGTERM)


def _outcome(task: Task, future: concurrent.futures.Future) -> tuple[int, str]:
    """Exit status of a task's process, and the end of its log, or the reason if the process could not run."""
    try:
        status = future.result()
    except Exception as error:
        return 1, f"lost ({type(error).__name__}: {error}); the same command tries it again"
    text = task.log.read_text(errors="replace") if task.log.is_file() else ""
    lines = [line.strip() for line in text.splitlines() if line.strip()][-TAIL_LINES:] or ["..."]
    return status, "\n".join([*lines, *([f"(ended by {signal.Signals(-status).name})"] if status < 0 else [])])
