"""Many tasks, each in a process of its own, some at a time: on this machine, or on all machines of a Dask cluster.

A task is a function call whose results are files, and which goes on where it was when it is called again. So nothing
needs to be kept here: whatever stops, the same call carries out the rest.

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
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learn3d.terminal import handled_by, note

STOPPED = 75  # exit status of a task that was stopped and can go on (sysexits' EX_TEMPFAIL)
TAIL_LINES = 5  # of a failed task's log, shown at the end
SECONDS_BETWEEN_LINES = 60.0
SECONDS_KEPT = 3600.0  # of a file that stops tasks which a cluster has lost
LOST = "the cluster lost it: its scheduler or its workers have ended; the same command tries it again"
MOST_LINES = 8  # about tasks that are under way

_CHILD = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from learn3d.distributed import tasks; "
_CHILD += "tasks._child()"


@dataclass(frozen=True)
class Task:
    """A call in a process of its own."""

    name: str  # for messages
    function: Callable[..., bool]  # of a module; False where it was asked to stop (SIGTERM) and can go on
    arguments: tuple[Any, ...]
    log: Path  # what it prints is appended here


def run_tasks(
    tasks: Sequence[Task],
    folder: Path,
    *,
    jobs: int = 1,
    cluster: str | None = None,
    say: Callable[[str], None] = note,
) -> dict[str, str]:
    """Carry out `tasks`, at most `jobs` at a time on this machine, or as many as the workers of a cluster take.

    A failing task does not stop the others. SIGINT, SIGTERM or SIGHUP stop all of them: each is asked to save its
    state, nothing new is started, and what was running counts as stopped; a second SIGINT ends them at once. Returns
    the end of the log of every task that failed, by the task's name.

    folder: where a file is put that stops the tasks, which all machines must see. cluster: the address of a Dask
    scheduler (tcp://HOST:8786), or the file that it was told to write (--scheduler-file). When a worker dies another
    one carries out its task, three times at most; when the scheduler ends, its tasks have failed.

    Raises OSError where no scheduler answers.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob(".stop-*"):  # left where tasks were lost
        if time.time() - old.stat().st_mtime > SECONDS_KEPT:
            old.unlink(missing_ok=True)
    stop = folder / f".stop-{uuid.uuid4().hex}"  # its content says how: soon, or now
    received: list[int] = []
    failed: dict[str, str] = {}
    started = last_report = time.time()
    try:
        with handled_by(received.append), _executor(jobs, cluster) as executor:
            where, path = os.getcwd(), pickle.dumps(sys.path)
            waiting = {
                executor.submit(_carry_out, path + pickle.dumps(task), str(task.log), str(stop), where): task
                for task in tasks
            }
            try:
                while waiting:
                    ended, _ = concurrent.futures.wait(waiting, 0.1, concurrent.futures.FIRST_COMPLETED)
                    if received and not stop.exists():
                        say("stopping: what runs saves its state (once more: end it at once)")
                        stop.write_text("soon")
                    if signal.SIGINT in received[1:]:
                        stop.write_text("now")
                    for future in ended:
                        task = waiting.pop(future)
                        count = f"[{len(tasks) - len(waiting)}/{len(tasks)}]"
                        if text := _ending(task, future, bool(received), failed, LOST if cluster else ""):
                            say(f"{count} {task.name}: {text}")
                    if waiting and time.time() - last_report >= SECONDS_BETWEEN_LINES:
                        last_report = time.time()
                        for line in _under_way(list(waiting.values()), started):
                            say(line)
            finally:
                if waiting or LOST in failed.values():  # an error; what still runs somewhere is not to go on unseen
                    stop.write_text("soon")
    finally:
        if LOST not in failed.values():
            stop.unlink(missing_ok=True)
    return failed


@contextlib.contextmanager
def _executor(jobs: int, cluster: str | None) -> Iterator[concurrent.futures.Executor]:
    """Where tasks are started: in threads of this process, or by the workers of a cluster."""
    if cluster is None:
        with concurrent.futures.ThreadPoolExecutor(jobs) as threads:
            yield threads
        return
    from distributed import Client

    address = {"scheduler_file": cluster} if Path(cluster).is_file() else {"address": cluster}
    try:
        client = Client(**address, timeout=10, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(
            f"no Dask scheduler answers at {cluster} ({error}); start one (dask scheduler), and give its address "
            "(tcp://HOST:8786) or the file of --scheduler-file"
        ) from error
    with client, client.get_executor(pure=False) as workers:
        yield workers


def _carry_out(pickled: bytes, log: str, stop: str, folder: str) -> tuple[int, float]:
    """Carry out a pickled task in a new process; its exit status and the seconds that it took."""
    log_file, stop_file, begin = Path(folder, log), Path(folder, stop), time.monotonic()
    if stop_file.exists():
        return STOPPED, 0.0
    asked = False
    log_file.parent.mkdir(parents=True, exist_ok=True)
    with (
        open(log_file, "ab") as output,
        subprocess.Popen(
            [sys.executable, "-c", _CHILD], stdin=subprocess.PIPE, stdout=output, stderr=output, cwd=folder
        ) as process,
    ):
        with contextlib.suppress(OSError):  # it has ended already
            process.stdin.write(pickled)
            process.stdin.flush()
        while True:
            try:
                return process.wait(0.1), time.monotonic() - begin
            except subprocess.TimeoutExpired:
                with contextlib.suppress(OSError):
                    if stop_file.read_text() == "now":
                        process.kill()
                    elif not asked:
                        process.terminate()  # not SIGINT: Ctrl-C has sent that already, and a second one ends at once
                        asked = True


def _child() -> None:
    """What the process of a task does."""
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
    """Ask this process to save its state and to end when the one that started it is gone, for whatever reason."""
    os.read(sys.stdin.fileno(), 1)  # nothing ever comes but the end
    os.kill(os.getpid(), signal.SIGTERM)


def _ending(task: Task, future: concurrent.futures.Future, stopping: bool, failed: dict[str, str], lost: str) -> str:
    """How a task ended, in a line; "" where it was never begun. Failures are added to `failed`.

    lost: what is said of a task whose process could not be started or watched; "": the error itself.
    """
    try:
        status, seconds = future.result()
    except (Exception, concurrent.futures.CancelledError) as error:
        if stopping:
            return "stopped"
        failed[task.name] = lost or f"error: {error}"
        return f"lost ({type(error).__name__}: {error})"
    if status == STOPPED and not seconds:
        return ""
    if status == STOPPED or (stopping and status):
        end = "stopped"
    elif status:
        end = "failed"
        killed = [f"(ended by {signal.Signals(-status).name})"] if status < 0 else []
        failed[task.name] = "\n".join([*_tail(task), *killed])
    else:
        end = "done"
    return f"{end} after {seconds / 60:.1f} min; {_tail(task)[-1]}"


def _under_way(tasks: Sequence[Task], since: float) -> list[str]:
    """A line about each of the first tasks that have printed something."""
    lines = []
    for task in tasks[:100]:
        with contextlib.suppress(OSError):
            if task.log.stat().st_mtime >= since:
                lines.append(f"  {task.name}: {_tail(task)[-1]}")
    return lines[:MOST_LINES]


def _tail(task: Task) -> list[str]:
    """The last lines of a task's log."""
    text = task.log.read_text(errors="replace") if task.log.is_file() else ""
    return [line.strip() for line in text.splitlines() if line.strip()][-TAIL_LINES:] or ["..."]
