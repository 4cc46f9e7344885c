"""The number of CPU threads of a training: one or all, whichever makes its steps faster.

Threads meet hundreds of times a step, and all of them wait for one that has no core. On a machine whose cores are busy
a step with all threads takes up to 14 times as long as with one; on a quiet one it takes a fraction. So both are tried.
"""

from __future__ import annotations

import os
import statistics
from collections import deque
from collections.abc import Callable

import torch

WARM_UP, TRIAL = 1, 5  # steps of a trial: the first is not timed, as memory and kernels are prepared in it
WINDOW = 20  # steps whose median is compared with the best so far
SLOWER = 3.0  # ratio of the two medians at which both numbers are tried again
REST = 1000  # steps with one thread after which all are tried again; then after twice as many, and so on


class ThreadTuner:
    """Chooses between one thread and all by the duration of training steps.

    It does nothing if the number is fixed: by `threads`, by the environment (OMP_NUM_THREADS), or because there is only
    one core.
    """

    def __init__(self, threads: int | None, *, set_num_threads: Callable[[int], None] = torch.set_num_threads) -> None:
        self.all = threads or torch.get_num_threads()
        self.fixed = threads is not None or "OMP_NUM_THREADS" in os.environ or self.all == 1
        self._set_num_threads = set_num_threads
        self._seconds: deque[float] = deque(maxlen=WINDOW)  # of the last steps with this number of threads
        self._best = float("inf")  # the least median of WINDOW steps
        self._medians: dict[int, float] = {}  # of the trial under way, by the number of threads
        self._trying, self._rest = not self.fixed, REST
        self._use(self.all)

    def resume(self, chosen: int | None) -> None:
        """Go on with the number that an interrupted run had chosen, if this machine has as many cores."""
        if not self.fixed and chosen is not None and chosen <= self.all:
            self._trying = False
            self._use(chosen)

    @property
    def chosen(self) -> int | None:
        """The number of threads to go on with after an interruption; None if it is fixed or not chosen yet."""
        return None if self.fixed or self._trying else self.threads

    def __str__(self) -> str:
        """The number of threads, for the line in which a run introduces itself."""
        return f"{self.all} threads or 1, whichever is faster" if self._trying else f"{self.threads} threads"

    def after_step(self, seconds: float) -> str:
        """Take in the duration of a step. Returns a line for the log when the number has been chosen, else ""."""
        if self.fixed:
            return ""
        self._seconds.append(seconds)
        self._steps += 1
        if self._trying:
            return self._try()
        if len(self._seconds) == WINDOW:
            median = statistics.median_low(self._seconds)
            self._best = min(self._best, median)
            tired = self.threads == 1 and self._steps >= self._rest
            if median > SLOWER * self._best or tired:
                self._rest = 2 * self._rest if tired else REST
                self._trying, self._medians = True, {}
                self._use(self.all)
        return ""

    def _try(self) -> str:
        if len(self._seconds) < TRIAL:
            return ""
        self._medians[self.threads] = statistics.median(list(self._seconds)[WARM_UP:])
        if self.threads == self.all:
            self._use(1)
            return ""
        self._trying, self._best = False, min(self._medians.values())
        times = {count: f"{1000 * self._medians[count]:.0f} ms a step" for count in (1, self.all)}
        self._use(min(self._medians, key=self._medians.__getitem__))
        other = self.all if self.threads == 1 else 1
        return f"threads: {self.threads} ({times[self.threads]}; with {other}: {times[other]}); --threads fixes it"

    def _use(self, threads: int) -> None:
        self.threads = threads
        self._seconds.clear()
        self._steps = 0
        self._set_num_threads(threads)
