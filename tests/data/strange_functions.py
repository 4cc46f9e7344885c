"""Functions that misbehave in a worker process in every way that we know of."""

from __future__ import annotations

import ctypes
import os
import sys
import time
from pathlib import Path

import numpy as np

from learn3d.files import sandbox


def size(path: Path) -> int:
    return os.stat(path).st_size


def crash(path: Path) -> None:
    ctypes.string_at(0)


def spin(path: Path) -> None:
    while True:
        pass


def sleep(path: Path, seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def eat(path: Path) -> int:
    return len([bytearray(2**20) for _ in range(100_000)])


def keep(path: Path, megabytes: int, held: list = []) -> int:  # noqa: B006
    sandbox.allow(megabytes * 2**20)
    held.append(bytearray(megabytes * 2**20))
    return os.getpid()


def fail(path: Path) -> None:
    raise KeyError("a strange word")


def arrays(path: Path) -> dict[str, object]:
    large = np.arange(2**20, dtype=np.int32).reshape(1024, 1024)
    return {
        "large": large,
        "fortran": np.asfortranarray(large),
        "row": large[:, 3],
        "small": np.eye(3),
        "word": "x",
    }


def modules(path: Path) -> list[str]:
    return sorted(sys.modules)
