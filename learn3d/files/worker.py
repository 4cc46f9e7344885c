"""Reading strangers' files in processes of their own, which may crash, hang or fill their memory without harm to us.

`read` and `read_all` run functions in worker processes. Workers are started when first needed, one for each core that
this process may use, and fed many files. Whatever goes wrong with a file is a `DamagedFile` or `MissingFile`, one
sentence that names it: an exception, a crash (which no Python code can catch), too much memory or too much time. A
worker that dies is replaced. Memory is limited on Linux, processor time on POSIX systems; elsewhere (Windows) a crash
is still contained, and a worker that does not answer for a minute and longer is ended.
"""

from __future__ import annotations

import atexit
import contextlib
import mmap
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

from learn3d.files.child import MEMORY, SECONDS, Call
from learn3d.files.findings import FETCH_AGAIN, DamagedFile, MissingFile

_PATIENCE = 60.0  # seconds that a worker may be silent, beside one for every MiB of the file: disks can be slow
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def read(
    function: Callable[..., Any],
    path: Path | str,
    *arguments: Any,
    wanted: str = "a sound file",
    memory: int = MEMORY,
    seconds: float = SECONDS,
) -> Any:
    """function(path, *arguments), computed in a worker process.

    function: of a module that does not import torch; it returns arrays and plain values. wanted: what the file should
    be, for messages. memory: bytes that it may take beside its result; seconds: of processor time. A function that has
    found out that a file is worth more asks for it with `child.allow`.

    Raises DamagedFile and MissingFile.
    """
    (result,) = _run([Call(function, Path(path), arguments, wanted, memory, seconds)])
    if isinstance(result, (DamagedFile, MissingFile)):
        raise result
    return result


def read_all(groups: Iterable[Sequence[Call]]) -> Iterator[list[Any]]:
    """What the calls of each group return, in the order of the groups, read on all cores.

    A group (the files of one object, say) is read by one worker. What is wrong with a file stands in its place as a
    DamagedFile or MissingFile. Only a few groups are read ahead of the one that is asked for.
    """
    ahead = deque()
    with ThreadPool(cores()) as threads:  # each waits for a worker; an interruption does not wait for them
        for group in groups:
            ahead.append(threads.apply_async(_run, [list(group)]))
            if len(ahead) > 2 * cores():
                yield ahead.popleft().get()
        while ahead:
            yield ahead.popleft().get()


def together(functions: Sequence[Callable[[], Any]]) -> list[Any]:
    """What functions that use `read_all` return, called at the same time, so that they share the cores."""
    with ThreadPool(len(functions)) as threads:
        results = [threads.apply_async(function) for function in functions]
        return [result.get() for result in results]


def cores() -> int:
    """How many workers this process may have: its cores, shared with the processes that were started beside it."""
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    beside = os.environ.get("LOCAL_WORLD_SIZE") or os.environ.get("PYTEST_XDIST_WORKER_COUNT") or "1"
    return max(1, own // max(1, int(beside)))


class _Worker:
    """A process that runs `child.serve`."""

    def __init__(self) -> None:
        paths = [str(Path(__file__).parents[2]), *sys.path]
        code = f"import sys; sys.path[:] = {paths!r}; from learn3d.files import child; child.serve()"
        self.process = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", code],  # without the start-up files of site-packages
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
        )
        _workers.add(self)

    def exchange(self, request: bytes, patience: float) -> tuple[list[Any], bool]:
        """The answer to a request, and whether the process has grown too large to be kept.

        EOFError or OSError where it has died, or has not answered after `patience` seconds.
        """
        timer = threading.Timer(patience, self.process.kill)
        timer.daemon = True
        timer.start()
        try:
            self.process.stdin.write(request)
            self.process.stdin.flush()
            data, files, grown = pickle.load(self.process.stdout)
            buffers = [self._shared(file) for file in files]
            if files:
                self.process.stdin.write(b".")  # it may close them now
                self.process.stdin.flush()
            return pickle.loads(data, buffers=buffers), grown
        finally:
            timer.cancel()

    def _shared(self, number: int) -> mmap.mmap:
        """Memory that the process has made as an open file."""
        with open(f"/proc/{self.process.pid}/fd/{number}", "r+b") as file:
            return mmap.mmap(file.fileno(), 0)

    def end(self) -> int:
        """Kill the process, which keeps nothing that would have to be saved. Returns its exit status."""
        _workers.discard(self)
        self.process.kill()
        status = self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):
                stream.close()
        return status


def _start_afresh() -> None:
    """Also in a copy of this process made by os.fork: the workers are those of the original."""
    global _workers, _slots
    _workers, _slots = set(), queue.LifoQueue()
    for _ in range(cores()):
        _slots.put(None)


_workers: set[_Worker]  # all that are alive
_slots: queue.LifoQueue[_Worker | None]  # one for each core: an idle worker, or None where it is to be started
_start_afresh()
atexit.register(lambda: [worker.end() for worker in list(_workers)])
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_afresh)


def _run(calls: list[Call]) -> list[Any]:
    """The results of calls in one worker."""
    request, patience, slots = pickle.dumps((_folder(), calls), 5), sum(map(_patience, calls)), _slots
    worker, started = slots.get(), time.monotonic()
    try:
        if worker is not None and worker.process.poll() is not None:
            worker.end()
            worker = None
        worker = worker or _Worker()
        try:
            results, grown = worker.exchange(request, patience)
            if grown:
                worker.end()
            return results
        except (EOFError, OSError, pickle.UnpicklingError):
            status = worker.end()
        except BaseException:
            worker.end()
            raise
    finally:
        slots.put(worker)
    if len(calls) > 1:  # one of them was it
        return [_run([call])[0] for call in calls]
    if status == -getattr(signal, "SIGXCPU", 0):
        fault = f"reading it takes more than {calls[0].seconds:g} seconds of processor time"
    elif time.monotonic() - started > patience:
        fault = f"reading it was stopped after {patience:.0f} seconds"
    else:
        fault = f"the process that read it crashed (status {status})"
    return [DamagedFile(calls[0].path, f"{fault}; expected {calls[0].wanted}. {FETCH_AGAIN}")]


def _folder() -> str | None:
    """The current folder, which relative paths begin at; it may have changed since a worker was started."""
    try:
        return os.getcwd()
    except OSError:  # it has been removed
        return None


def _patience(call: Call) -> float:
    """Seconds on the clock after which a worker is given up."""
    try:
        size = os.stat(call.path).st_size
    except (OSError, ValueError):
        size = 0
    return _PATIENCE + call.seconds + size / 2**20
