"""Keeps glibc from handing the step's large buffers back to the kernel, only to ask for them again in the next step."""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4  # <malloc.h>


def keep_freed_memory() -> bool:
    """Let this process reuse freed memory instead of returning it; True where that could be set (Linux with glibc).

    Every large tensor is otherwise mapped, page by page, and unmapped again in each step: a quarter of the step's CPU
    time at batch 128 (LOG.md). Resident memory stays at its peak.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    return all((mallopt(_M_MMAP_MAX, 0), mallopt(_M_TRIM_THRESHOLD, 2**31 - 1), mallopt(_M_TOP_PAD, 1 << 27)))
