"""Many tasks, each in its own process, some at a time: on this machine, or on all machines of a Dask cluster.

A task is a function call that leaves files, and goes on where it was when it is called again. So nothing is kept here:
whatever stops, the same call of `run_tasks` runs the rest.

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
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learn3d.terminal import note, stop_on_signal

STOPPED = 75  # exit status of a task that was stopped and can go on (sysexits' EX_TEMPFAIL)
TAIL_LINES = 5  # of a failed task's log
SECONDS_BETWEEN_REPORTS = 60.0
MOST_LINES = 8  # of a report about running tasks
LOST = "the cluster lost it: its scheduler or its workers have ended; the same command tries it again"

_CHILD = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from learn3d.distributed import tasks; "
_CHILD += "tasks._child()"


@dataclass(frozen=True)
class Task:
    """A function call in its own process."""

    name: str  # for messages
    function: Callable[..., bool]  # importable; returns False if it was stopped by SIGTERM and can go on
    arguments: tuple[Any, ...]
    log: Path  # its output is appended here


def run_tasks(
    tasks: Sequence[Task], *, jobs: int = 1, cluster: str | None = None, say: Callable[[str], None] = note
) -> dict[str, str]:
    """Run `tasks`, at most `jobs` at a time on this machine, or as many as the workers of a cluster take.

    A failing task does not stop the others. SIGINT, SIGTERM or SIGHUP stop all of them: nothing new is started, and
    each running task saves its state. Returns the end of the log of every failed task, by the task's name.

    cluster: the address of a Dask scheduler (tcp://HOST:8786), or the file that it writes with --scheduler-file. If a
    worker dies another one takes over its task, three times at most. If the scheduler ends, its tasks fail.

    Raises OSError if no scheduler answers.
    """
    failed: dict[str, str] = {}
    started = last_report = time.time()
    with stop_on_signal() as asked, _executor(jobs, cluster) as (executor, stop):
        where, path = os.getcwd(), pickle.dumps(sys.path)
        waiting = {
            executor.submit(_run_in_process, path + pickle.dumps(task), str(task.log), where, stop): task
            for task in tasks
        }
        try:
            while waiting:
                ended, _ = concurrent.futures.wait(waiting, 0.1, concurrent.futures.FIRST_COMPLETED)
                if asked.name and not stop.is_set():
                    say("stopping: running tasks save their state")
                    stop.set()
                for future in ended:
                    task = waiting.pop(future)
                    if text := _outcome(task, future, bool(asked.name), failed, LOST if cluster else ""):
                        say(f"[{len(tasks) - len(waiting)}/{len(tasks)}] {task.name}: {text}")
                if waiting and time.time() - last_report >= SECONDS_BETWEEN_REPORTS:
                    last_report = time.time()
                    running = [task for task in waiting.values() if _modified(task.log) >= started]
                    for task in running[:MOST_LINES]:
                        say(f"  {task.name}: {_tail(task)[-1]}")
        finally:
            if waiting:  # an error: no task goes on unseen
                with contextlib.suppress(Exception):
                    stop.set()
    return failed


@contextlib.contextmanager
def _executor(jobs: int, cluster: str | None) -> Iterator[tuple[concurrent.futures.Executor, Any]]:
    """What starts tasks, threads of this process or the workers of a cluster, and the event that stops them."""
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


def _run_in_process(pickled: bytes, log: str, folder: str, stop: Any) -> tuple[int, float]:
    """Run a pickled task in a new process; returns its exit status and the seconds that it took."""
    log_file, begin = Path(folder, log), time.monotonic()
    if stop.is_set():
        return STOPPED, 0.0
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
        return process.wait(), time.monotonic() - begin


def _child() -> None:
    """The main function of a task's process."""
    task = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    try:
        finished = task.function(*task.arguments)
    except (ValueError, OSError, FloatingPointError, MemoryError) as error:
        note(f"error: {error}")
        sys.exit(1)
    except KeyboardInterrupt:  # before or after the work, which saves by itself
        finished = False
    sys.exit(0 if finished else STOPPED)


def _stop_with_parent() -> None:
    """Ask this process to save its state and end if the one that started it ends, for whatever reason."""
    os.read(sys.stdin.fileno(), 1)  # returns when the pipe is closed
    os.kill(os.getpid(), signal.SIGTERM)


def _outcome(task: Task, future: concurrent.futures.Future, stopping: bool, failed: dict[str, str], lost: str) -> str:
    """One line about how a task ended, "" if it was never begun. Failures are added to `failed`."""
    try:
        status, seconds = future.result()
    except (Exception, concurrent.futures.CancelledError) as error:
        if stopping:
            return "stopped"
        failed[task.name] = lost or f"error: {error}"
        return f"lost ({type(error).__name__}: {error})"
    if status == STOPPED and not seconds:
        return ""
    end = "done" if status == 0 else "stopped" if stopping or status == STOPPED else "failed"
    if end == "failed":
        killed = [f"(ended by {signal.Signals(-status).name})"] if status < 0 else []
        failed[task.name] = "\n".join([*_tail(task), *killed])
    return f"{end} after {seconds / 60:.1f} min; {_tail(task)[-1]}"


def _modified(log: Path) -> float:
    return log.stat().st_mtime if log.is_file() else 0.0


def _tail(task: Task) -> list[str]:
    """The last lines of a task's log."""
    text = task.log.read_text(errors="replace") if task.log.is_file() else ""
    return [line.strip() for line in text.splitlines() if line.strip()][-TAIL_LINES:] or ["..."]
