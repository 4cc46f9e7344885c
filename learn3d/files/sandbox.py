"""A sandbox for untrusted files: worker processes that may crash, hang or run out of memory.

`read` and `read_all` run functions in workers, with limits of memory (on Linux), processor time and elapsed time. Two
more than there are cores start on demand, and read many files each. A failure becomes a `DamagedFile` or `MissingFile`
with the name of the file, and a dead worker is replaced. This module imports neither torch nor scipy, so that a worker
starts in a tenth of a second. It needs a POSIX system.
"""

import atexit
import contextlib
import math
import mmap
import os
import pickle
import resource
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from multiprocessing.reduction import recv_handle, send_handle
from pathlib import Path
from typing import Any

import numpy as np

from learn3d.files.reading import FETCH_AGAIN, DamagedFile, MissingFile, faults_of

MEMORY = 256 * 2**20  # bytes that a call may allocate; large arrays made by `empty` do not count
SECONDS = 5.0  # processor time of a call
_GROWTH = 256 * 2**20  # a worker that keeps more bytes after its calls is replaced
_LARGE = 2**20  # size in bytes from which `empty` uses shared memory
_LINUX = sys.platform == "linux"
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Call:
    """One file to read: function(path, *arguments). The module of the function should not import torch."""

    function: Callable[..., Any]
    path: Path
    arguments: tuple[Any, ...] = ()
    wanted: str = "an intact file"  # description of the file, for messages
    memory: int = MEMORY  # limit in bytes, without the result
    seconds: float = SECONDS  # limit of processor time
    timeout: float = 600.0  # limit of elapsed seconds; disks can be slow


def read(function: Callable[..., Any], path: Path | str, *arguments: Any, **options: Any) -> Any:
    """function(path, *arguments), computed in a worker. options: other fields of `Call`.

    The function returns arrays and plain values. It can raise its limits with `allow`. Raises DamagedFile and
    MissingFile.
    """
    ((result,),) = read_all([[Call(function, Path(path), arguments, **options)]])
    if isinstance(result, Exception):
        raise result
    return result


def read_all(groups: Iterable[Sequence[Call]]) -> Iterator[list[Any]]:
    """The results of each group of calls, in order, computed on all cores.

    A worker takes a whole group, for example the files of one object. The result for a bad file is a DamagedFile or
    MissingFile. Two groups more than there are cores are read ahead, at most.
    """
    groups, running, most = iter(groups), deque(), cores() + 2
    try:
        while True:
            while len(running) < most and (calls := next(groups, None)) is not None:
                running.append((_start(list(calls)), list(calls)))
            if not running:
                return
            results = _finish(*running[0])
            running.popleft()
            yield results
    finally:  # after an interruption some workers are still busy
        for worker, _ in running:
            worker.end()


def cores() -> int:
    """The number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Worker:
    """A process that runs `_serve`."""

    def __init__(self) -> None:
        self.connection, theirs = Pipe()
        paths, end = [str(Path(__file__).parents[2]), *sys.path], theirs.fileno()
        code = f"import sys; sys.path[:] = {paths!r}; from learn3d.files import sandbox; sandbox._serve({end})"
        silent = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)  # libraries print warnings
        with theirs:  # -S -E: skip the start-up files of site-packages
            command = [sys.executable, "-S", "-E", "-c", code]
            self.process = subprocess.Popen(command, pass_fds=[end], env={**os.environ, **_ONE_THREAD}, **silent)
        _workers.add(self)

    def end(self) -> int:
        """Kill the process. Returns its exit status."""
        _workers.discard(self)
        self.process.kill()
        self.connection.close()
        return self.process.wait()


def _start(calls: list[Call]) -> _Worker:
    """Send calls to an idle worker, or to a new one."""
    while _idle:
        worker = _idle.pop()
        if worker.process.poll() is None:
            break
        worker.end()  # it died while it was idle
    else:
        worker = _Worker()
    with contextlib.suppress(OSError):  # if the worker has died, `_finish` finds out
        worker.connection.send((os.getcwd(), calls))
    return worker


def _finish(worker: _Worker, calls: list[Call]) -> list[Any]:
    """Wait for the results of a worker; if it dies, find the file at fault."""
    buffers = []
    try:
        data, sizes, grown = worker.connection.recv()
        for size in sizes:
            with open(recv_handle(worker.connection), "r+b") as file:
                buffers.append(memoryview(mmap.mmap(file.fileno(), size)))
        worker.end() if grown else _idle.append(worker)
        return pickle.loads(data, buffers=buffers)
    except (EOFError, OSError, pickle.UnpicklingError):
        status = worker.end()
    if len(calls) > 1:
        return [next(read_all([[call]]))[0] for call in calls]
    fault = {
        -signal.SIGXCPU: f"takes more than {calls[0].seconds:g} seconds of processor time",
        -signal.SIGALRM: f"was stopped after {calls[0].timeout:g} seconds",
    }.get(status, f"crashed its process (status {status})")
    return [DamagedFile(calls[0].path, f"reading it {fault}; expected {calls[0].wanted}. {FETCH_AGAIN}")]


_workers: set[_Worker] = set()  # all living workers
_idle: list[_Worker] = []
atexit.register(lambda: [worker.end() for worker in list(_workers)])
os.register_at_fork(after_in_child=lambda: (_workers.clear(), _idle.clear()))  # they belong to the original


# The rest runs in workers.

_limits: tuple[float, float] | None = None  # bytes of private memory, seconds of processor time; None if no worker
_shared: dict[int, int] = {}  # address of an array in shared memory -> its file descriptor


def allow(memory: int = 0, seconds: float = 0.0) -> None:
    """Raise the limits of the running call by bytes and seconds, for a file whose header shows an acceptable size."""
    if _limits is not None:
        _limit(_limits[0] + memory, _limits[1] + seconds)


def empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An uninitialised array. On Linux a large one is in shared memory, so that the parent gets it without a copy."""
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    if _limits is None or size < _LARGE or not _LINUX:
        return np.empty(shape, dtype)
    file = os.memfd_create("learn3d")
    os.ftruncate(file, size)
    array = np.frombuffer(mmap.mmap(file, size), dtype).reshape(shape)
    _shared[array.ctypes.data] = file
    return array


def _serve(end: int) -> None:
    """Run the requests, each a current folder and a list of calls, until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent kills workers after an interruption
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    start = _memory()
    with contextlib.suppress(EOFError, OSError), Connection(end) as connection:
        while True:
            folder, calls = connection.recv()
            os.chdir(folder)
            results, sent = [_attempt(call) for call in calls], []
            signal.setitimer(signal.ITIMER_REAL, 0)

            def in_band(buffer: pickle.PickleBuffer, sent: list[tuple[int, int]] = sent) -> bool:
                content = np.frombuffer(buffer.raw(), np.uint8)
                if shared := content.ctypes.data in _shared:
                    sent.append((_shared[content.ctypes.data], content.nbytes))
                return not shared

            data = pickle.dumps(results, 5, buffer_callback=in_band)
            connection.send((data, [size for _, size in sent], _memory() - start > _GROWTH))
            for file, _ in sent:
                send_handle(connection, file, None)
            for file in _shared.values():
                os.close(file)
            _shared.clear()
            del results, data


def _attempt(call: Call) -> Any:
    """The result of the call, or the fault of its file as a DamagedFile or MissingFile."""
    _limit(_memory() + call.memory, time.process_time() + call.seconds)
    signal.setitimer(signal.ITIMER_REAL, call.timeout)  # SIGALRM ends the process
    try:
        with faults_of(call.path, call.wanted):
            try:
                return call.function(call.path, *call.arguments)
            finally:  # an error message takes memory, too
                _limit(math.inf, math.inf)
    except (DamagedFile, MissingFile) as error:
        return error


def _limit(memory: float, seconds: float) -> None:
    """Limit the private memory of this process in bytes, and its processor time; math.inf for no limit."""
    global _limits
    _limits = memory, seconds
    # Only Linux counts malloc's large blocks in RLIMIT_DATA.
    for kind, value in ((resource.RLIMIT_CPU, seconds), (resource.RLIMIT_DATA, memory if _LINUX else math.inf)):
        hard = resource.getrlimit(kind)[1]
        most = math.inf if hard == resource.RLIM_INFINITY else hard
        resource.setrlimit(kind, (hard if value >= most else math.ceil(value), hard))


def _memory() -> int:
    """Bytes of private memory of this process; 0 on other systems than Linux."""
    return int(Path("/proc/self/statm").read_text().split()[5]) * mmap.PAGESIZE if _LINUX else 0
