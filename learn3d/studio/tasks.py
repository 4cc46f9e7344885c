"""Runs tasks, each in its own process, a few at a time.

A task is a function call that writes files and continues from them when it is called again. So an interrupted
`run_tasks` is resumed by the same call.
"""

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learn3d.terminal import INTERRUPTED, note, stop_on_signal, without_traceback

TAIL_LINES = 5  # lines of a failed task's log that are shown
_CHILD = "import pickle, sys; sys.path[:], task = pickle.load(sys.stdin.buffer); "
_CHILD += "from learn3d.studio import tasks; sys.exit(tasks._child(task))"


@dataclass(frozen=True)
class Task:
    """A function call in its own process."""

    name: str  # for messages
    function: Callable[..., bool]  # importable; returns False if SIGTERM stopped it and it can be resumed
    arguments: tuple[Any, ...]
    log: Path  # file to which its output is appended


def run_tasks(tasks: Sequence[Task], *, jobs: int = 1) -> list[str]:
    """Run `tasks`, at most `jobs` at a time; return the names of those that failed.

    A failing task does not stop the others; the end of its log is shown. After SIGINT, SIGTERM or SIGHUP no task is
    started, and each running one saves its state and ends.
    """
    waiting, running, failed = list(tasks), {}, []
    with stop_on_signal() as asked:
        try:
            while (waiting or running) and not asked.name:
                while waiting and len(running) < jobs:
                    task = waiting.pop(0)
                    try:
                        running[_start(task)] = task
                    except OSError as error:  # its log cannot be written
                        failed.append(task.name)
                        note(f"FAILED {task.name}: {error}")
                time.sleep(0.1)
                for process in [process for process in running if process.poll() is not None]:
                    task, status = running.pop(process), process.wait()
                    ended = f"[{len(tasks) - len(waiting) - len(running)}/{len(tasks)}]"
                    tail = _tail(task.log, status)
                    if status in (0, INTERRUPTED) or asked.name:
                        note(f"{ended} {task.name}: {'stopped' if status else 'done'}; {tail.splitlines()[-1]}")
                    else:
                        failed.append(task.name)
                        note(f"{ended} FAILED {task.name}; the end of its log:\n{tail}")
        finally:
            if running:
                note("stopping: running tasks save their state")
            for process in running:
                process.terminate()  # not SIGINT: Ctrl-C has sent it already; a second one would end the task at once
            for process in running:
                process.wait()
    return failed


def _start(task: Task) -> subprocess.Popen:
    task.log.parent.mkdir(parents=True, exist_ok=True)
    with open(task.log, "ab") as output:
        command = [sys.executable, "-c", _CHILD]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output)
    with contextlib.suppress(OSError):  # the process has already ended
        process.stdin.write(pickle.dumps((sys.path, pickle.dumps(task))))
        process.stdin.flush()  # it stays open, see `_stop_with_parent`
    return process


@without_traceback
def _child(pickled: bytes) -> int:
    """The main function of a task's process."""
    task = pickle.loads(pickled)
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    return 0 if task.function(*task.arguments) else INTERRUPTED


def _stop_with_parent() -> None:
    """Send SIGTERM to this process when its parent has ended for any reason."""
    os.read(sys.stdin.fileno(), 1)  # returns when the pipe is closed
    os.kill(os.getpid(), signal.SIGTERM)


def _tail(log: Path, status: int) -> str:
    """The last lines of a task's log, and the signal that ended its process."""
    text = log.read_text(errors="replace") if log.is_file() else ""
    lines = [line.strip() for line in text.splitlines() if line.strip()] or ["..."]
    ended = [f"(ended by {signal.Signals(-status).name})"] if status < 0 else []
    return "\n".join(lines[-TAIL_LINES:] + ended)
