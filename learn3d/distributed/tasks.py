"""Many tasks, each in its own process, some at a time: on this machine, or on all machines of a Dask cluster.

A task is a function call that leaves files, and goes on from them when it is called again. So nothing is kept here: the
same call of `run_tasks` runs the rest.

On a cluster every worker thread of Dask starts the processes of its tasks, one after the other. All machines see the
same files under the same names, and have learn3d installed.
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
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learn3d.terminal import INTERRUPTED, note, stop_on_signal, without_traceback

TAIL_LINES = 5  # of a failed task's log
_CHILD = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
_CHILD += "from learn3d.distributed import tasks; sys.exit(tasks._child())"


@dataclass(frozen=True)
class Task:
    """A function call in its own process."""

    name: str  # for messages
    function: Callable[..., bool]  # importable; returns False if it was stopped by SIGTERM and can go on
    arguments: tuple[Any, ...]
    log: Path  # its output is appended here


def run_tasks(tasks: Sequence[Task], *, jobs: int = 1, cluster: str | None = None) -> dict[str, str]:
    """Run `tasks`, at most `jobs` at a time on this machine, or as many as the workers of a cluster take.

    A failing task does not stop the others. SIGINT, SIGTERM or SIGHUP stop all of them: nothing new is started, and
    each running task saves its state. Returns the end of the log of every failed task, by the task's name.

    cluster: the address of a Dask scheduler (tcp://HOST:8786), or the file that it writes with --scheduler-file. If a
    worker dies another one takes over its task, three times at most. If the scheduler ends, its tasks fail.

    Raises OSError if no scheduler answers.
    """
    failed: dict[str, str] = {}
    with stop_on_signal() as asked, _executor(jobs, cluster) as (executor, stop):
        path, folder = pickle.dumps(sys.path), os.getcwd()
        waiting = {
            executor.submit(_run_in_process, path + pickle.dumps(task), folder, str(task.log), stop): task
            for task in tasks
        }
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
            with contextlib.suppress(Exception):  # the scheduler may be gone
                stop.set()  # after an error no task goes on unseen
    return failed


@contextlib.contextmanager
def _executor(jobs: int, cluster: str | None) -> Iterator[tuple[concurrent.futures.Executor, Any]]:
    """Threads of this process, or the workers of a cluster, that start tasks; and the event that stops them."""
    if cluster is None:
        with concurrent.futures.ThreadPoolExecutor(jobs) as threads:
            yield threads, threading.Event()
        return
    from distributed import Client, Event

    address = {"scheduler_file": cluster} if Path(cluster).is_file() else {"address": cluster}
    try:
        client = Client(**address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(
            f"no Dask scheduler answers at {cluster} ({error}); start one (dask scheduler), and give its address "
            "(tcp://HOST:8786) or the file of --scheduler-file"
        ) from error
    with client, client.get_executor(pure=False) as workers:
        yield workers, Event(client=client)


def _run_in_process(pickled: bytes, folder: str, log: str, stop: Any) -> int:
    """Run a pickled task in a new process; returns its exit status."""
    if stop.is_set():
        return INTERRUPTED
    log_file = Path(folder, log)
    log_file.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-c", _CHILD]
    with (
        open(log_file, "ab") as output,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output, cwd=folder) as process,
    ):
        with contextlib.suppress(OSError):  # it has ended already
            process.stdin.write(pickled)
            process.stdin.flush()
        try:
            while process.poll() is None and not stop.is_set():
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(0.2)
        finally:  # on a cluster the scheduler may be gone
            process.terminate()  # not SIGINT: Ctrl-C has sent that already, and a second one ends at once
        return process.wait()


@without_traceback(FloatingPointError, MemoryError)
def _child() -> int:
    """The main function of a task's process."""
    task = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    return 0 if task.function(*task.arguments) else INTERRUPTED


def _stop_with_parent() -> None:
    """Ask this process to save its state and end if the one that started it ends, for whatever reason."""
    os.read(sys.stdin.fileno(), 1)  # returns when the pipe is closed
    os.kill(os.getpid(), signal.SIGTERM)


def _outcome(task: Task, future: concurrent.futures.Future) -> tuple[int, str]:
    """Exit status of a task's process, and the end of its log or, if it was lost, the reason."""
    try:
        status = future.result()
    except (Exception, concurrent.futures.CancelledError) as error:
        return 1, f"lost ({type(error).__name__}: {error}); the same command tries it again"
    text = task.log.read_text(errors="replace") if task.log.is_file() else ""
    lines = [line.strip() for line in text.splitlines() if line.strip()][-TAIL_LINES:] or ["..."]
    return status, "\n".join([*lines, *([f"(ended by {signal.Signals(-status).name})"] if status < 0 else [])])
