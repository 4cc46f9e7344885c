"""The environment of programs that tests start, and waiting for them."""

import os
import sys
import time
from collections.abc import Callable


def environment(**more: str) -> dict[str, str]:
    """That of this process; the programs find the same packages, and have one thread and no GPU."""
    fixed = {
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
    }
    return os.environ | fixed | more


def wait_until(what: Callable[[], object], seconds: float = 60) -> None:
    """Return when `what` is true. Raises AssertionError if that takes longer."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, f"it did not happen within {seconds} seconds"
        time.sleep(0.01)
