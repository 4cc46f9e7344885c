"""What runs in a worker process (see `worker`): one file after another, within limits of memory and processor time.

A worker imports neither torch nor scipy nor trimesh before a file needs them, so that it starts in a tenth of a second.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from learn3d.files.findings import FETCH_AGAIN, DamagedFile, MissingFile

try:
    import resource
except ImportError:  # Windows
    resource = None

MEMORY = 256 * 2**20  # bytes that a call may add to its worker; results made by `empty` do not count
SECONDS = 5.0  # of processor time
LARGE = 2**20  # bytes of an array from which on it goes to the parent as shared memory
_GROWN = 256 * 2**20  # bytes by which a worker may have grown after a call; beyond, it is replaced


@dataclass(frozen=True)
class Call:
    """One thing to read: function(path, *arguments), by a function of a module that does not import torch."""

    function: Callable[..., Any]
    path: Path
    arguments: tuple[Any, ...] = ()
    wanted: str = "a sound file"  # what the file should be, for messages
    memory: int = MEMORY
    seconds: float = SECONDS


_shared: dict[int, int] | None = None  # in a worker: its open files by the address of the array in it


def allow(memory: int = 0, seconds: float = 0.0) -> None:
    """Let the call that runs now take more, once it is known to be worth it: its header gives a size we can hold."""
    if _shared is None or resource is None:
        return
    if memory and sys.platform == "linux":
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (_below(soft + memory, hard), hard))
    if seconds:
        soft, hard = resource.getrlimit(resource.RLIMIT_CPU)
        resource.setrlimit(resource.RLIMIT_CPU, (_below(soft + math.ceil(seconds), hard), hard))


def empty(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array to be filled; on Linux a large one lies in memory that the parent shares, so that it is not copied."""
    dtype = np.dtype(dtype)
    size = math.prod(shape) * dtype.itemsize
    if _shared is None or size < LARGE or sys.platform != "linux":
        return np.empty(shape, dtype)
    file = os.memfd_create("learn3d")
    os.ftruncate(file, size)
    array = np.frombuffer(mmap.mmap(file, size), dtype).reshape(shape)
    _shared[array.ctypes.data] = file
    return array


def serve() -> None:
    """Answer requests on the standard input, current folders and lists of calls, until it is closed."""
    global _shared
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what an interruption ends
    _shared = {}
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    start = _memory()
    silence = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):  # what libraries print is no answer, and nobody's concern
        os.dup2(silence, stream)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            folder, calls = pickle.load(requests)
            if folder is not None:
                os.chdir(folder)
            results = [_attempt(call) for call in calls]
            _limit(None, None)
            data, files = _pickled(results)
            pickle.dump((data, files, _memory() - start > _GROWN), answers)
            answers.flush()
            if files:
                requests.read(1)  # the parent has opened them
            for file in (*files, *_shared.values()):
                os.close(file)
            _shared.clear()
            del results, data


def _attempt(call: Call) -> Any:
    """What the call returns, or what is wrong with its file as a DamagedFile or MissingFile."""
    _limit(call.memory, call.seconds)
    try:
        return call.function(call.path, *call.arguments)
    except (DamagedFile, MissingFile) as error:
        return error
    except FileNotFoundError:
        return MissingFile(call.path, f"is missing; expected {call.wanted}")
    except MemoryError:
        _limit(None, None)
        return DamagedFile(call.path, f"reading it would take too much memory; expected {call.wanted}")
    except Exception as error:  # the libraries raise whatever a damaged file leads them to
        return DamagedFile(call.path, f"cannot be read ({one_line(error)}); expected {call.wanted}. {FETCH_AGAIN}")


def one_line(error: Exception) -> str:
    """The first line of an error's text, with its kind where that says more than "ValueError"."""
    reason = (str(error).strip().splitlines() or [""])[0][:300]
    return reason if reason and type(error) is ValueError else f"{type(error).__name__}: {reason}"


def _limit(memory: int | None, seconds: float | None) -> None:
    """Limit what is taken from now on; None: no longer."""
    if resource is None:
        return
    if sys.platform == "linux":  # elsewhere the limit does not count what malloc takes in large pieces
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (hard if memory is None else _below(_memory() + memory, hard), hard))
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    used = time.process_time()
    resource.setrlimit(
        resource.RLIMIT_CPU, (hard if seconds is None else _below(math.ceil(used + seconds), hard), hard)
    )


def _below(wanted: int, hard: int) -> int:
    """A limit that the system's own, where it has one, allows."""
    return wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)


def _memory() -> int:
    """Bytes of private memory of this process; 0 where that cannot be told."""
    if sys.platform != "linux":
        return 0
    with open("/proc/self/statm", "rb", buffering=0) as file:
        return int(file.read().split()[5]) * mmap.PAGESIZE


def _pickled(results: list[Any]) -> tuple[bytes, list[int]]:
    """Results to be sent: pickled, but for large arrays, which are open files of shared memory."""
    files = []

    def in_band(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < LARGE or sys.platform != "linux":
            return True
        source = np.frombuffer(raw, np.uint8)
        file = _shared.pop(source.ctypes.data, None)
        if file is None or os.fstat(file).st_size != raw.nbytes:
            copy = empty((raw.nbytes,), np.uint8)
            copy[:] = source
            file = _shared.pop(copy.ctypes.data)
        files.append(file)
        return False

    return pickle.dumps(results, 5, buffer_callback=in_band), files
