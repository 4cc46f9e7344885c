"""Signals that end work in good order."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass
class Stop:
    requested: bool = False
    name: str = ""


@contextlib.contextmanager
def stop_on_signal() -> Iterator[Stop]:
    """Turn the first SIGINT, SIGTERM or SIGHUP into a request to stop; a second SIGINT interrupts at once."""
    stop = Stop()

    def handle(number: int) -> None:
        if stop.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        stop.requested, stop.name = True, signal.Signals(number).name

    with handled_by(handle):
        yield stop


@contextlib.contextmanager
def handled_by(handle: Callable[[int], None]) -> Iterator[None]:
    """Call `handle` with the number of each SIGINT, SIGTERM and SIGHUP while the block runs.

    SIGHUP comes when the terminal is closed. Where it is ignored (nohup) it stays so.
    """
    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    previous: dict[int, object] = {}
    try:
        for number in numbers:
            with contextlib.suppress(ValueError):  # not the main thread: leave signals alone
                previous[number] = signal.signal(number, lambda received, frame: handle(received))
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
