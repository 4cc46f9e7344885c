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
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from learn3d.files.child import MEMORY, SECONDS, Call
from learn3d.files.findings import AGAIN, DamagedFile, MissingFile

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
    (result,) = _run([Call(function, Path(path), arguments, wanted, memory, seconds)], _Job())
    if isinstance(result, (DamagedFile, MissingFile)):
        raise result
    return result


def read_all(groups: Iterable[Sequence[Call]]) -> Iterator[list[Any]]:
    """What the calls of each group return, in the order of the groups, read on all cores.

    A group (the files of one object, say) is read by one worker. What is wrong with a file stands in its place as a
    DamagedFile or MissingFile. Only a few groups are read ahead of the one that is asked for.
    """
    job, ahead = _Job(), deque()
    executor = ThreadPoolExecutor(cores())
    _jobs.add(job)
    try:
        for group in groups:
            ahead.append(executor.submit(_run, list(group), job))
            if len(ahead) > 2 * cores():
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        _jobs.discard(job)
        executor.shutdown(wait=False, cancel_futures=True)
        job.stop()  # after an exception or an interruption; else nothing runs any more


def together(functions: Sequence[Callable[[], Any]]) -> list[Any]:
    """What functions that use `read_all` return, called at the same time, so that they share the cores."""
    if len(functions) == 1:
        return [functions[0]()]
    with ThreadPoolExecutor(len(functions)) as executor:
        futures = [executor.submit(function) for function in functions]
        try:
            return [future.result() for future in futures]
        except BaseException:
            for job in list(_jobs):
                job.stop()
            raise


def cores() -> int:
    """How many workers this process may have: its cores, shared with the processes that were started beside it."""
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    beside = os.environ.get("LOCAL_WORLD_SIZE") or os.environ.get("PYTEST_XDIST_WORKER_COUNT") or "1"
    return max(1, own // max(1, int(beside)))


class _Worker:
    """A process that runs `child.serve`."""

    def __init__(self) -> None:
        self.channel, theirs = socket.socketpair() if hasattr(socket, "send_fds") else (None, None)
        number = -1 if theirs is None else theirs.fileno()
        paths = [str(Path(__file__).parents[2]), *sys.path]
        code = f"import sys; sys.path[:] = {paths!r}; from learn3d.files import child; child.serve({number})"
        self.process = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", code],  # without the start-up files of site-packages
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[] if theirs is None else [number],
            env={**os.environ, **_ONE_THREAD},
        )
        if theirs is not None:
            theirs.close()
        self.ready, self.last, self.deadline = False, False, float("inf")

    def exchange(self, request: bytes) -> list[Any]:
        """The answer to a request; EOFError or OSError where the process has died."""
        self.process.stdin.write(request)
        self.process.stdin.flush()
        if not self.ready:
            try:
                self.ready = pickle.load(self.process.stdout) == "ready"
            except EOFError:
                raise RuntimeError("a process for reading files could not be started; see the error above") from None
        data, sizes, self.last = pickle.load(self.process.stdout)
        buffers = []
        for size in sizes:
            _, files, _, _ = socket.recv_fds(self.channel, 1, 1)
            if not files:
                raise EOFError
            buffers.append(mmap.mmap(files[0], size))
            os.close(files[0])
        return pickle.loads(data, buffers=buffers)

    def end(self) -> None:
        """Kill the process, which keeps nothing that would have to be saved."""
        self.process.kill()

    def release(self) -> int:
        """Wait for the end of the process and close what is open to it. Returns its exit status."""
        status = self.process.wait()
        self.close()
        return status

    def close(self) -> None:
        for stream in (self.process.stdin, self.process.stdout, self.channel):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


class _Pool:
    """The workers of this process."""

    def __init__(self) -> None:
        self.slots = threading.Semaphore(cores())
        self.idle: list[_Worker] = []
        self.working: set[_Worker] = set()
        self.lock = threading.Lock()
        threading.Thread(target=self._watch, name="watch over reading", daemon=True).start()

    def take(self) -> _Worker:
        """A living worker."""
        with self.lock:
            while self.idle:
                worker = self.idle.pop()
                if worker.process.poll() is None:
                    break
                worker.release()
            else:
                worker = _Worker()
            self.working.add(worker)
            return worker

    def give_back(self, worker: _Worker, usable: bool) -> None:
        worker.deadline = float("inf")
        with self.lock:
            self.working.discard(worker)
            if usable:
                self.idle.append(worker)

    def _watch(self) -> None:
        while True:
            time.sleep(1.0)
            for worker in list(self.working):
                if time.monotonic() > worker.deadline:
                    worker.end()

    def close(self) -> None:
        for worker in (*self.idle, *self.working):
            worker.end()
            worker.release()


_the_pool: _Pool | None = None
_making = threading.Lock()


def _pool() -> _Pool:
    global _the_pool
    with _making:
        if _the_pool is None:
            _the_pool = _Pool()
            atexit.register(_the_pool.close)
        return _the_pool


def _forget() -> None:
    """In a copy of this process made by os.fork: the workers are those of the original."""
    global _the_pool, _making
    _making = threading.Lock()
    if _the_pool is not None:
        atexit.unregister(_the_pool.close)
        for worker in (*_the_pool.idle, *_the_pool.working):
            worker.close()
        _the_pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


class _Job:
    """What `read_all` has under way."""

    def __init__(self) -> None:
        self.busy: set[_Worker] = set()
        self.stopped = False  # nobody waits for the results any more
        self.lock = threading.Lock()

    def stop(self) -> None:
        with self.lock:
            self.stopped = True
            for worker in self.busy:
                worker.end()

    def leave(self, worker: _Worker) -> bool:
        """Take a worker out; whether it is alive, for it may have been stopped a moment after its answer."""
        with self.lock:
            self.busy.discard(worker)
            return not self.stopped


_jobs: set[_Job] = set()  # of all threads


def _run(calls: list[Call], job: _Job) -> list[Any]:
    """The results of calls in one worker."""
    if job.stopped:
        raise CancelledError
    pool, request, patience = _pool(), pickle.dumps(calls, 5), sum(map(_patience, calls))
    with pool.slots:
        worker, usable, started = pool.take(), False, time.monotonic()
        worker.deadline = started + patience
        with job.lock:
            job.busy.add(worker)
        try:
            results = worker.exchange(request)
            usable = not worker.last
            return results
        except (EOFError, OSError, pickle.UnpicklingError):
            status = worker.release()
        except BaseException:
            worker.end()
            worker.release()
            raise
        finally:
            alive = job.leave(worker)
            pool.give_back(worker, usable and alive)
            if worker.last or not alive:
                worker.end()
                worker.release()
    if len(calls) > 1 or job.stopped:  # one of them was it
        return [_run([call], job)[0] for call in calls]
    if status == -getattr(signal, "SIGXCPU", 0):
        fault = f"reading it takes more than {calls[0].seconds:g} seconds of processor time"
    elif time.monotonic() - started > patience:
        fault = f"reading it was stopped after {patience:.0f} seconds"
    else:
        fault = f"the process that read it crashed (status {status})"
    return [DamagedFile(calls[0].path, f"{fault}; expected {calls[0].wanted}. {AGAIN}")]


def _patience(call: Call) -> float:
    """Seconds on the clock after which a worker is given up."""
    try:
        size = os.stat(call.path).st_size
    except (OSError, ValueError):
        size = 0
    return _PATIENCE + call.seconds + size / 2**20
