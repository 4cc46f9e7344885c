"""Notices a run whose threads do not get the cores that they ask for."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

#: Less than this share of the cores asked for is worth a warning. A step alone on its cores gets 0.9 and more.
ENOUGH = 0.75


class CoreShare:
    """Compares the CPU time of this process with the time that passes, once, in the first `seconds` of a run.

    `processes` share this machine. Where threads are idle by nature (`waits`: for a GPU, for other processes) only
    their number is compared with that of the cores.

    Threads meet at a barrier hundreds of times a step. Where other programs take a core from one of them (or a
    container has fewer cores than its machine), all wait until it runs again: two threads beside another busy program
    on two cores took 15 times as long for a step (LOG.md), and nothing but the clock tells.
    """

    def __init__(
        self,
        threads: int,
        *,
        processes: int = 1,
        waits: bool = False,
        seconds: float = 20.0,
        skipped_steps: int = 1,
        cores: int | None = None,
        clock: Callable[[], float] = time.monotonic,
        cpu_clock: Callable[[], float] = time.process_time,
    ) -> None:
        self.threads, self.processes = threads, processes
        self.cores = usable_cores() if cores is None else cores
        self.seconds = seconds
        self._skipped = skipped_steps  # the first one also allocates memory and chooses kernels
        self._clock, self._cpu_clock = clock, cpu_clock
        self._start: tuple[float, float] | None = None
        self._done = threads * processes < 2  # one thread waits for nobody, and there is no better number
        self._waits = waits or threads < 2

    def warning(self) -> str | None:
        """Call it after each step: a sentence once the share is known and small, None otherwise."""
        if self._done:
            return None
        if self.threads * self.processes > self.cores:
            self._done = True
            have = f"{self.threads} threads"
            if self.processes > 1:
                have = f"{self.processes} processes of {self.threads} thread{'s' * (self.threads > 1)} each"
            advice = f"--threads {self.cores // self.processes}" if self.processes <= self.cores else "fewer processes"
            return f"{have} on {self.cores} cores wait for each other; stop with Ctrl-C and continue with {advice}"
        if self._waits:
            self._done = True
            return None
        if self._skipped > 0:
            self._skipped -= 1
            return None
        now = (self._clock(), self._cpu_clock())
        if self._start is None:
            self._start = now
        passed, used = (b - a for a, b in zip(self._start, now, strict=True))
        if passed < self.seconds:
            return None
        self._done = True
        if used / passed >= ENOUGH * self.threads:
            return None
        fitting = max(1, int(used / passed + 0.25))
        return (
            f"{self.threads} threads got the time of {used / passed:.1f} of {self.cores} cores: other programs are "
            f"busy, or this one may not use all cores. Threads that wait for each other can make a step many times "
            f"slower; if it stays so, stop with Ctrl-C and continue with --threads {fitting}"
        )


def usable_cores() -> int:
    """Cores that this process may use; a container's share of their time, if it has one, is not seen here."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
