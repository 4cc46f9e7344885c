"""Device, precision, memory and threads of the networks.

Threads synchronise hundreds of times a step. If cores are oversubscribed, a step with all threads
takes up to 14 times as long as with one; on an idle machine it takes a fraction. So both are
measured at the start.
"""

import ctypes
import os
import statistics
from pathlib import Path
from typing import Literal

import torch
from typing_extensions import Self  # in typing from Python 3.11 on

from learn3d.distributed import world_size

CPUINFO = "/proc/cpuinfo"  # Linux lists the CPU's instruction sets here


def resolve_precision(
    precision: Literal["auto", "bf16", "fp32"], device: str
) -> Literal["bf16", "fp32"]:
    """Turn 'auto' into the faster precision: bf16 on CUDA and CPUs with fast bf16, else fp32.

    Fast are AMX, and AVX-512's on AMD's processors: they halve the time of the networks. With
    Intel's AVX-512 instructions alone bf16 takes 1.2 times the time of fp32; without any it is
    emulated.
    """
    if precision != "auto":
        return precision
    if device == "cuda":
        return "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "fp32"
    cpu = Path(CPUINFO).read_text() if Path(CPUINFO).exists() else ""
    fast = "amx_bf16" in cpu or ("AuthenticAMD" in cpu and "avx512_bf16" in cpu)
    return "bf16" if fast else "fp32"


_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4  # <malloc.h>


def keep_freed_memory() -> bool:
    """Let this process reuse freed memory instead of returning it; True if that worked (Linux
    with glibc).

    By default each step maps and unmaps the pages of every large tensor, a quarter of its CPU
    time at batch 128. Resident memory stays at its peak.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # another C library
        return False
    return all(
        (
            mallopt(_M_MMAP_MAX, 0),
            mallopt(_M_TRIM_THRESHOLD, 2**31 - 1),
            mallopt(_M_TOP_PAD, 1 << 27),
        )
    )


WARM_UP, TRIAL = 1, 5  # steps at the start of a trial that are not timed, and all of its steps


class ThreadTuner:
    """Chooses between one thread and all by the duration of the first training steps.

    The number is fixed if `threads` or the environment (OMP_NUM_THREADS) sets it, if there is
    only one core, or if several ranks train together. As a context it restores the number before.
    """

    def __init__(self, threads: int | None) -> None:
        self._before = torch.get_num_threads()
        self.all = threads or self._before
        self.fixed = (
            threads is not None
            or "OMP_NUM_THREADS" in os.environ
            or self.all == 1
            or world_size() > 1
        )
        self._trying = not self.fixed
        self._seconds: list[float] = []  # durations of a trial with all threads, then one with 1
        self._use(self.all)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._use(self._before)

    def resume(self, chosen: int | None) -> None:
        """Use the number that the run had chosen before it was interrupted, if this machine has
        as many cores.
        """
        if not self.fixed and chosen is not None and chosen <= self.all:
            self._trying = False
            self._use(chosen)

    @property
    def chosen(self) -> int | None:
        """The chosen number of threads, for `resume`; None if it is fixed or not chosen yet."""
        return None if self.fixed or self._trying else self.threads

    def __str__(self) -> str:
        """The number of threads, for the first line of a run's log."""
        if self._trying:
            return f"{self.all} threads or 1, whichever is faster"
        return f"{self.threads} thread{'s' * (self.threads > 1)}"

    def after_step(self, seconds: float) -> str:
        """Record the duration of a step.

        Returns a line for the log when a number is chosen, else "".
        """
        if not self._trying:
            return ""
        self._seconds.append(seconds)
        if len(self._seconds) == TRIAL:
            self._use(1)
        if len(self._seconds) < 2 * TRIAL:
            return ""
        trials = {self.all: self._seconds[:TRIAL], 1: self._seconds[TRIAL:]}
        medians = {count: statistics.median(times[WARM_UP:]) for count, times in trials.items()}
        faster, slower = sorted(medians, key=medians.__getitem__)
        self._trying = False
        self._use(faster)
        times = {count: f"{1000 * median:.0f} ms a step" for count, median in medians.items()}
        compared = f"{times[faster]}; with {slower}: {times[slower]}"
        return f"threads: {faster} ({compared}); --threads fixes it"

    def _use(self, threads: int) -> None:
        self.threads = threads
        torch.set_num_threads(threads)
