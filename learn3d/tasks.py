"""Runs tasks, each in a process of its own: a few at a time on this machine, or on the workers of
a Dask cluster.

A task is a function call that writes files and continues from them when it is called again. So an
interrupted `run_tasks` is resumed by the same call, and a task whose process or worker died is
started again.
"""

import collections
import concurrent.futures
import contextlib
import os
import pickle
import platform
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learn3d.settings import Count, checked
from learn3d.terminal import INTERRUPTED, note, stop_on_signal, without_traceback

TAIL_LINES = 5  # lines of a failed task's log that are shown
RESTARTS = 5  # times that a task is started again after its process or worker died
POLL_SECONDS = 0.5  # how often a worker asks whether its task is to stop
#: Linux says here who gets huge pages.
HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")
_HUGE_TUNABLE = "glibc.malloc.hugetlb"
_CHILD = "import pickle, sys; sys.path[:], task = pickle.load(sys.stdin.buffer); "
_CHILD += "from learn3d import tasks; sys.exit(tasks._child(task))"


@checked
class Workers:
    """The processes that run the tasks of a command."""

    jobs: Count = 1
    """Number of processes at a time on this machine."""
    cluster: str | None = None
    """Address of a Dask scheduler, such as tcp://HOST:8786. Its workers run the pieces; all
    machines must see the same files under the same names. If not given: processes on this
    machine."""

    def __post_init__(self) -> None:
        if self.cluster is not None and self.jobs > 1:
            raise ValueError(
                f"--jobs {self.jobs} does not go with --cluster, whose workers decide; leave it out"
            )

    @property
    def threads(self) -> int:
        """Threads of each task: its share of this machine's cores; 1 on a cluster, which has a
        worker for each core.
        """
        import torch  # here, as the processes of a cluster need none

        return 1 if self.cluster else max(1, torch.get_num_threads() // self.jobs)


ONE_WORKER = Workers()


@dataclass(frozen=True)
class Task:
    """A function call in its own process."""

    name: str  # for messages
    # importable; returns False if SIGTERM stopped it and it can be resumed
    function: Callable[..., bool]
    arguments: tuple[Any, ...]
    log: Path  # file to which its output is appended


def run_tasks(tasks: Sequence[Task], workers: Workers) -> list[str]:
    """Run `tasks` on `workers`; return the names of those that failed.

    A failing task does not stop the others; the end of its log is shown. A task whose process or
    worker died is started again, up to `RESTARTS` times. After SIGINT, SIGTERM or SIGHUP no task
    is started, and each running one saves its state and ends. Raises OSError if no scheduler
    answers at `workers.cluster`.
    """
    failed = []
    starts = collections.Counter()
    with stop_on_signal() as asked, _executor(workers) as (executor, stop):

        def start(task: Task) -> concurrent.futures.Future:
            starts[task.name] += 1
            return executor.submit(run_task, pickle.dumps(task), task.log, os.getcwd(), stop)

        running = {start(task): task for task in tasks}
        try:
            while running and not asked.name:
                for future in concurrent.futures.wait(
                    running, 0.1, concurrent.futures.FIRST_COMPLETED
                ).done:
                    task = running.pop(future)
                    status, tail = _outcome(future)
                    died = status < 0 or status == INTERRUPTED
                    if died and starts[task.name] <= RESTARTS and not asked.name:
                        note(f"{task.name} is started again: {tail.splitlines()[-1]}")
                        running[start(task)] = task
                        continue
                    ended = f"[{len(tasks) - len(running)}/{len(tasks)}]"
                    if status == 0 or asked.name:
                        note(
                            f"{ended} {task.name}: {'stopped' if status else 'done'}; {tail.splitlines()[-1]}"
                        )
                    else:
                        failed.append(task.name)
                        note(f"{ended} FAILED {task.name}; the end of its log:\n{tail}")
        finally:
            if running:
                note("stopping: running tasks save their state")
                stop.set()
    return failed


def make_missing(tasks: Mapping[Path, Task], workers: Workers, things: str) -> int:
    """Run the tasks whose files, the keys, do not exist.

    Returns the exit status of a command: 0 if all files exist then, 1 if a task failed, 130 after
    a signal. `things` names the files in the message.
    """
    left = [task for path, task in tasks.items() if not path.is_file()]
    note(f"{len(tasks)} {things}, {len(left)} to be made")
    failed = run_tasks(left, workers)
    if missing := sum(not path.is_file() for path in tasks):
        note(f"{missing} of {len(tasks)} {things} are missing; the same command makes them")
        return 1 if failed else INTERRUPTED
    return 0


@contextlib.contextmanager
def _executor(workers: Workers) -> Iterator[tuple[concurrent.futures.Executor, Any]]:
    """The executor of tasks, and the event that stops them.

    At the end it waits for those that run.
    """
    if workers.cluster is None:
        with concurrent.futures.ThreadPoolExecutor(workers.jobs) as threads:
            yield threads, threading.Event()
        return
    try:
        from distributed import Client, Event
    except ModuleNotFoundError:
        raise ValueError(
            "--cluster needs the package distributed; install the extra cluster of this package"
        ) from None
    try:
        client = Client(workers.cluster, timeout=30, set_as_default=False)
    except (OSError, ValueError) as error:
        advice = "start one (dask scheduler), and give the address that it prints (tcp://HOST:8786)"
        raise OSError(
            f"no Dask scheduler answers at {workers.cluster} ({error}); {advice}"
        ) from None
    with client, client.get_executor(pure=False) as executor:
        _check_versions(client)
        yield executor, Event(client=client)


def _check_versions(client: Any) -> None:
    """Raise OSError if the scheduler or a worker has another version of Dask: such a worker ends
    at its first task, and the command would wait for it.
    """
    found = client.get_versions()
    places = {"this process": found["client"], "the scheduler": found["scheduler"]}
    versions = {
        place: about["packages"]["distributed"]
        for place, about in (places | found["workers"]).items()
    }
    if len(set(versions.values())) > 1:
        named = ", ".join(f"{version} in {place}" for place, version in versions.items())
        raise OSError(f"the versions of Dask's package distributed differ: {named[:500]}")


def run_task(task: bytes, log: Path, folder: str, stop: Any) -> tuple[int, str]:
    """Run a pickled task in a new process with the current folder `folder`, until it ends or
    `stop` is set.

    Returns its exit status, and the end of its log.
    """
    if stop.is_set():
        return INTERRUPTED, "not started"
    log = Path(folder, log)
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "ab") as output:
            command = [sys.executable, "-c", _CHILD]
            streams = {"stdin": subprocess.PIPE, "stdout": output, "stderr": output}
            process = subprocess.Popen(command, **streams, cwd=folder, env=process_environment())
    except OSError as error:
        return 1, str(error)
    try:
        with contextlib.suppress(OSError):  # the process has already ended
            process.stdin.write(pickle.dumps((sys.path, task)))
            process.stdin.flush()  # it stays open, see `_stop_with_parent`
        while process.poll() is None and not stop.is_set():
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(POLL_SECONDS)
    finally:  # even if the scheduler no longer answers
        process.terminate()  # not SIGINT: Ctrl-C has sent it already; a second one would end the task at once
        status = process.wait()
    return status, _tail(log, status)


def process_environment() -> dict[str, str]:
    """The environment of a process that trains: this one, with an allocator that suits it.

    Without Dask's setting that malloc returns memory at once, which is slow. With glibc's option
    that large tensors lie in huge pages, so that a core looks up fewer addresses, unless the
    environment has this option already, or the kernel gives huge pages to all or to nobody. Only
    the environment before the start of a process sets it.
    """
    environment = {k: v for k, v in os.environ.items() if k != "MALLOC_TRIM_THRESHOLD_"}
    tunables = environment.get("GLIBC_TUNABLES", "")
    on_request = HUGE_PAGES.is_file() and "[madvise]" in HUGE_PAGES.read_text()
    if platform.libc_ver()[0] == "glibc" and on_request and _HUGE_TUNABLE not in tunables:
        tunables = [*filter(None, [tunables]), f"{_HUGE_TUNABLE}=1"]
        environment["GLIBC_TUNABLES"] = ":".join(tunables)
    return environment


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


def _outcome(future: concurrent.futures.Future) -> tuple[int, str]:
    """Exit status and end of the log of a task, as `run_task` returns them; status -1 if its
    worker died.
    """
    try:
        return future.result()
    except concurrent.futures.CancelledError:
        return 1, "the Dask scheduler ended; start it, and the same command goes on"
    except Exception as error:  # Dask's KilledWorker
        return -1, f"its worker died ({type(error).__name__}: {error})"


def _tail(log: Path, status: int) -> str:
    """The last lines of a task's log, and the signal that ended its process."""
    text = log.read_text(errors="replace") if log.is_file() else ""
    lines = [line.strip() for line in text.splitlines() if line.strip()] or ["..."]
    ended = [f"(ended by {signal.Signals(-status).name})"] if status < 0 else []
    return "\n".join(lines[-TAIL_LINES:] + ended)
