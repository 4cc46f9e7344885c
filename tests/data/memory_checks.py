"""What Python and NumPy take at a time."""

from __future__ import annotations

import contextlib
import tracemalloc
from collections.abc import Iterator


@contextlib.contextmanager
def at_most(limit: int) -> Iterator[None]:
    """Fail where the block holds more than `limit` bytes at a time, beside what was held before."""
    tracemalloc.start()
    try:
        yield
    finally:  # after an error, too
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < limit, f"it took {peak} bytes, wanted less than {limit}"
