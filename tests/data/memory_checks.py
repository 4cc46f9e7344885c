"""What Python and NumPy take at a time."""

from __future__ import annotations

import contextlib
import threading
import tracemalloc
from collections.abc import Iterator

_threads_at_start: set[threading.Thread] = set()  # of the tracing


@contextlib.contextmanager
def at_most(limit: int) -> Iterator[None]:
    """Fail where the block holds more than `limit` bytes at a time, beside what was held before.

    Where the block leaves threads behind, tracing goes on until a later block finds them gone: Python 3.11 crashes
    where a thread allocates memory while tracing stops (python/cpython, issue 128679).
    """
    if not tracemalloc.is_tracing():
        _threads_at_start.clear()
        _threads_at_start.update(threading.enumerate())
        tracemalloc.start()
    tracemalloc.reset_peak()
    held = tracemalloc.get_traced_memory()[0]
    try:
        yield
    finally:  # after an error, too
        taken = tracemalloc.get_traced_memory()[1] - held
        if _threads_at_start.issuperset(threading.enumerate()):
            tracemalloc.stop()
        assert taken < limit, f"it took {taken} bytes, wanted less than {limit}"
