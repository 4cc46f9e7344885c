"""A sandbox for untrusted files: worker processes that may crash, hang or run out of memory.

`read` and `read_all` run functions in workers, with limits of memory (on Linux) and processor
time. Two more than there are cores start on demand, and read many files each. A failure becomes a
`DamagedFile` or `MissingFile` with the name of the file, and a dead worker is replaced. This
module imports neither torch nor NumPy, so that a worker starts in a tenth of a second. It needs a
POSIX system.
"""

import atexit
import contextlib
import mmap
import os
import pickle
import resource
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from types import ModuleType
from typing import Any

from learn3d.files.reading import FETCH_AGAIN, DamagedFile, MissingFile, faults_of

MEMORY = 256 * 2**20  # bytes that a call may allocate before it calls `allow`
SECONDS = 5.0  # processor time of a call, likewise
_GROWTH = 256 * 2**20  # a worker that keeps more bytes after its calls is replaced
_LINUX = sys.platform == "linux"
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Call:
    """One file to read: function(path, *arguments).

    The module of the function should not import torch.
    """

    function: Callable[..., Any]
    path: Path
    arguments: tuple[Any, ...] = ()
    wanted: str = "an intact file"  # description of the file, for messages
    seconds: float = SECONDS


def read(function: Callable[..., Any], path: Path | str, *arguments: Any, **options: Any) -> Any:
    """function(path, *arguments), computed in a worker. options: other fields of `Call`.

    The function returns arrays and plain values. It can raise its limits with `allow`. Raises
    DamagedFile and MissingFile.
    """
    ((result,),) = read_all([[Call(function, Path(path), arguments, **options)]])
    if isinstance(result, Exception):
        raise result
    return result


def read_all(groups: Iterable[Sequence[Call]]) -> Iterator[list[Any]]:
    """The results of each group of calls, in order, computed on all cores.

    A worker takes a whole group, for example the files of one object. The result for a bad file
    is a DamagedFile or MissingFile. Two groups more than there are cores are read ahead, at most.
    """
    groups = iter(groups)
    running = deque()
    most = cores() + 2
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
        paths = [str(Path(__file__).parents[2]), *sys.path]
        end = theirs.fileno()
        code = f"import sys; sys.path[:] = {paths!r}; from learn3d.files import sandbox; sandbox._serve({end})"
        # libraries print warnings
        silent = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        with theirs:  # -S -E: skip the start-up files of site-packages
            command = [sys.executable, "-S", "-E", "-c", code]
            self.process = subprocess.Popen(
                command, pass_fds=[end], env={**os.environ, **_ONE_THREAD}, **silent
            )
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
    try:
        data, sizes, grown = worker.connection.recv()
        buffers = [bytearray(size) for size in sizes]
        for buffer in buffers:
            worker.connection.recv_bytes_into(buffer)
        worker.end() if grown else _idle.append(worker)
        return pickle.loads(data, buffers=buffers)
    except (EOFError, OSError, pickle.UnpicklingError):
        status = worker.end()
    if len(calls) > 1:
        return [next(read_all([[call]]))[0] for call in calls]
    fault = f"crashed its process (status {status})"
    advice = FETCH_AGAIN
    if status == -signal.SIGPROF:
        fault = f"takes more than {calls[0].seconds:g} seconds of processor time"
        advice = "Make a smaller file of it, or leave it out"
    return [DamagedFile(calls[0].path, f"reading it {fault}; expected {calls[0].wanted}. {advice}")]


_workers: set[_Worker] = set()  # all living workers
_idle: list[_Worker] = []
atexit.register(lambda: [worker.end() for worker in list(_workers)])
# they belong to the original
os.register_at_fork(after_in_child=lambda: (_workers.clear(), _idle.clear()))


# The rest runs in workers.

_working = False  # True in a worker


def allow(memory: int, seconds: float = 0.0) -> None:
    """Raise the limits of the running call by bytes and seconds, for a large file."""
    if _working:
        left, _ = signal.getitimer(signal.ITIMER_PROF)
        _limit(resource.getrlimit(resource.RLIMIT_DATA)[0] + memory, left + seconds)


def _serve(end: int) -> None:
    """Run requests, each a folder and a list of calls, until the connection is closed."""
    global _working
    _working = True
    package = ModuleType("nmr")  # for nmr.obj: nmr's __init__ would import torch
    package.__path__ = [str(Path(__file__).parents[2] / "nmr")]
    sys.modules["nmr"] = package
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent kills workers after an interruption
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    start = _memory()
    with contextlib.suppress(EOFError, OSError), Connection(end) as connection:
        while True:
            folder, calls = connection.recv()
            os.chdir(folder)
            results = [_attempt(call) for call in calls]
            buffers = []
            # arrays are sent without copies
            data = pickle.dumps(results, 5, buffer_callback=buffers.append)
            buffers = [buffer.raw() for buffer in buffers]
            connection.send(
                (data, [buffer.nbytes for buffer in buffers], _memory() - start > _GROWTH)
            )
            for buffer in buffers:
                connection.send_bytes(buffer)
            del results, data, buffers


def _attempt(call: Call) -> Any:
    """The result of the call, or the fault of its file as a DamagedFile or MissingFile."""
    _limit(_memory() + MEMORY, call.seconds)
    try:
        with faults_of(call.path, call.wanted):
            try:
                return call.function(call.path, *call.arguments)
            finally:  # an error message takes memory, too
                _limit(resource.RLIM_INFINITY, 0)
    except (DamagedFile, MissingFile) as error:
        return error


def _limit(memory: int, seconds: float) -> None:
    """Limit the private memory of this process in bytes, and its further processor time;
    RLIM_INFINITY, 0: no limit.
    """
    signal.setitimer(signal.ITIMER_PROF, seconds)  # then SIGPROF ends the process
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    if memory == resource.RLIM_INFINITY or (hard != resource.RLIM_INFINITY and memory > hard):
        memory = hard
    if _LINUX:  # elsewhere it does not count malloc's large blocks
        resource.setrlimit(resource.RLIMIT_DATA, (memory, hard))


def _memory() -> int:
    """Bytes of private memory of this process; 0 on other systems than Linux."""
    return int(Path("/proc/self/statm").read_text().split()[5]) * mmap.PAGESIZE if _LINUX else 0
