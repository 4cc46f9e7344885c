"""One sandbox for untrusted files: worker processes that may crash, hang or fill their memory without harm to us.

`read` and `read_all` run functions in workers, which have limits of memory (on Linux), processor time and time. Workers
start when first needed, one for each core, and read many files each. Whatever goes wrong with a file, an exception, a
crash, too much memory or too much time, becomes a `DamagedFile` or `MissingFile`: one sentence that names the file.
A worker that dies is replaced. This module imports neither torch nor scipy, so that a worker starts in a tenth of a
second. It needs a POSIX system.
"""

from __future__ import annotations

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
from multiprocessing.connection import Connection, Pipe, wait
from multiprocessing.reduction import recv_handle, send_handle
from pathlib import Path
from typing import Any

import numpy as np

from learn3d.files.reading import FETCH_AGAIN, DamagedFile, MissingFile

MEMORY = 256 * 2**20  # bytes that a call may add to its worker; arrays made by `empty` do not count
SECONDS = 5.0  # processor time of a call
_PATIENCE = 600.0  # seconds that a worker may be silent, as disks can be slow
_GROWTH = 256 * 2**20  # bytes that a worker may keep after a call; beyond, it is replaced
_LARGE = 2**20  # bytes above which `empty` takes shared memory
_LINUX = sys.platform == "linux"
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Call:
    """One file to read: function(path, *arguments), by a function of a module that does not import torch."""

    function: Callable[..., Any]
    path: Path
    arguments: tuple[Any, ...] = ()
    wanted: str = "a sound file"  # description of the file, for messages
    memory: int = MEMORY  # bytes beside its result
    seconds: float = SECONDS  # processor time


def read(function: Callable[..., Any], path: Path | str, *arguments: Any, **options: Any) -> Any:
    """function(path, *arguments), computed in a worker; `options` are the other fields of `Call`.

    The function returns arrays and plain values. One that finds that its file deserves more than the usual limits calls
    `allow`. Raises DamagedFile and MissingFile.
    """
    ((result,),) = read_all([[Call(function, Path(path), arguments, **options)]])
    if isinstance(result, Exception):
        raise result
    return result


def read_all(groups: Iterable[Sequence[Call]]) -> Iterator[list[Any]]:
    """The results of each group of calls, in order, read on all cores.

    One worker reads a group (the files of one object, say). A DamagedFile or MissingFile takes the place of the result
    of a bad file. Only a few groups are read ahead of the one that is asked for.
    """
    groups, tasks, most = iter(groups), deque(), cores()
    try:
        while True:
            busy = {task.worker.connection: task for task in tasks if task.results is None}
            if len(busy) < most and len(tasks) < 2 * most and (calls := next(groups, None)) is not None:
                tasks.append(_Task(list(calls)))
            elif tasks and tasks[0].results is not None:
                yield tasks.popleft().results
            elif busy:
                for connection in wait(busy, 1.0):
                    busy[connection].receive()
                for task in busy.values():
                    if task.results is None and time.monotonic() > task.deadline:
                        task.receive()
            else:
                return
    finally:  # after an interruption some still read
        for task in tasks:
            if task.results is None:
                task.worker.end()


def cores() -> int:
    """The number of workers: the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Task:
    """A group of calls in a worker."""

    def __init__(self, calls: list[Call]) -> None:
        self.calls, self.deadline = calls, time.monotonic() + _PATIENCE
        self.results: list[Any] | None = None
        self.worker = _idle_worker()
        with contextlib.suppress(OSError):  # it died just now, which `receive` finds
            self.worker.connection.send((os.getcwd(), calls))

    def receive(self) -> None:
        """Take the results of the worker; if it has died or is late, a sentence about the file at fault."""
        try:
            if not self.worker.connection.poll():
                raise TimeoutError
            self.results, grown = self.worker.receive()
            self.worker.end() if grown else _idle.append(self.worker)
        except (EOFError, OSError, pickle.UnpicklingError):
            status = self.worker.end()
            single = len(self.calls) == 1
            self.results = [self._fault(status)] if single else [next(read_all([[call]]))[0] for call in self.calls]

    def _fault(self, status: int) -> DamagedFile:
        call, fault = self.calls[0], f"the process that read it crashed (status {status})"
        if status == -signal.SIGXCPU:
            fault = f"reading it takes more than {call.seconds:g} seconds of processor time"
        elif time.monotonic() > self.deadline:
            fault = f"reading it was stopped after {_PATIENCE:g} seconds"
        return DamagedFile(call.path, f"{fault}; expected {call.wanted}. {FETCH_AGAIN}")


class _Worker:
    """A process that runs `_serve`."""

    def __init__(self) -> None:
        self.connection, theirs = Pipe()
        paths, end = [str(Path(__file__).parents[2]), *sys.path], theirs.fileno()
        code = f"import sys; sys.path[:] = {paths!r}; from learn3d.files import sandbox; sandbox._serve({end})"
        silent = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)  # libraries print what nobody needs
        with theirs:  # -S -E: without the start-up files of site-packages
            command = [sys.executable, "-S", "-E", "-c", code]
            self.process = subprocess.Popen(command, pass_fds=[end], env={**os.environ, **_ONE_THREAD}, **silent)
        _workers.add(self)

    def receive(self) -> tuple[list[Any], bool]:
        """The results of its calls, and whether the process has grown too large to be kept."""
        data, sizes, grown = self.connection.recv()
        buffers = []
        for size in sizes:
            with open(recv_handle(self.connection), "r+b") as file:
                buffers.append(memoryview(mmap.mmap(file.fileno(), size)))
        return pickle.loads(data, buffers=buffers), grown

    def end(self) -> int:
        """Kill the process, which has nothing to save. Returns its exit status."""
        _workers.discard(self)
        self.process.kill()
        self.connection.close()
        return self.process.wait()


def _idle_worker() -> _Worker:
    while _idle:
        worker = _idle.pop()
        if worker.process.poll() is None:
            return worker
        worker.end()  # it died while it was idle
    return _Worker()


_workers: set[_Worker] = set()  # all that are alive
_idle: list[_Worker] = []
atexit.register(lambda: [worker.end() for worker in list(_workers)])
os.register_at_fork(after_in_child=lambda: (_workers.clear(), _idle.clear()))  # they belong to the original


# The rest runs in a worker.

_limits: tuple[float, float] | None = None  # bytes of private memory and seconds of processor time; None: no worker
_shared: dict[int, int] = {}  # open files of shared memory, by the address of the array in each


def allow(memory: int = 0, seconds: float = 0.0) -> None:
    """Let the call that runs now take more, once its file's header has shown a size that we can hold."""
    if _limits is not None:
        _limit(_limits[0] + memory, _limits[1] + seconds)


def empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array to be filled; on Linux a large one is memory that the parent shares, so that it is not copied."""
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
    """Answer requests, current folders and lists of calls, until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what an interruption ends
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    start = _memory()
    with contextlib.suppress(EOFError, OSError), Connection(end) as connection:
        while True:
            folder, calls = connection.recv()
            os.chdir(folder)
            results, sent = [_attempt(call) for call in calls], []
            _limit(math.inf, math.inf)

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
    try:
        return call.function(call.path, *call.arguments)
    except (DamagedFile, MissingFile) as error:
        return error
    except FileNotFoundError:
        return MissingFile(call.path, f"is missing; expected {call.wanted}")
    except MemoryError:
        _limit(math.inf, math.inf)
        return DamagedFile(call.path, f"reading it would take too much memory; expected {call.wanted}")
    except Exception as error:  # the libraries raise whatever a damaged file leads them to
        return DamagedFile(call.path, f"cannot be read ({reason(error)}); expected {call.wanted}. {FETCH_AGAIN}")


def reason(error: Exception) -> str:
    """The first line of an error's text, with its kind if that says more than "ValueError"."""
    text = (str(error).strip().splitlines() or [""])[0][:300]
    return text if text and type(error) is ValueError else f"{type(error).__name__}: {text}"


def _limit(memory: float, seconds: float) -> None:
    """Bound the private memory of this process, in bytes, and its processor time; math.inf for no bound."""
    global _limits
    _limits = memory, seconds
    # Elsewhere than on Linux RLIMIT_DATA does not count what malloc takes in large pieces.
    for kind, value in {resource.RLIMIT_CPU: seconds, **({resource.RLIMIT_DATA: memory} if _LINUX else {})}.items():
        hard = resource.getrlimit(kind)[1]
        most = math.inf if hard == resource.RLIM_INFINITY else hard
        resource.setrlimit(kind, (hard if value >= most else math.ceil(value), hard))


def _memory() -> int:
    """Bytes of private memory of this process; 0 if the system does not tell."""
    if not _LINUX:
        return 0
    with open("/proc/self/statm", "rb", buffering=0) as file:
        return int(file.read().split()[5]) * mmap.PAGESIZE
