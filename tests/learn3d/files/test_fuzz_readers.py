"""Every reader of files against damage: it gives sound data or one of its errors, in bounded time and memory.

Each target (`fuzz_targets`) is a folder of files that our own writers made; an example damages one of them
(`mutations`) and reads. What the readers leave to worker processes may crash there, which must become a sentence. A few
examples run here, the same every time; `--fuzz-examples 20000` looks for more.
"""

from __future__ import annotations

import contextlib
import random
import signal
import warnings
from collections.abc import Iterator

import pytest
from fuzz_targets import ERRORS, TARGETS, Target
from memory_checks import at_most

SECONDS = 20  # an example that takes longer is a hang
MEMORY = 400 * 2**20  # bytes that Python and NumPy may hold at a time


class Hang(BaseException):
    """No Exception, so that no reader takes it for one of its own."""


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Fail if the block takes too long or too much memory."""

    def stop(number: int, frame: object) -> None:
        raise Hang(f"still reading after {SECONDS} seconds")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        with at_most(MEMORY):
            yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def attack(target: Target, seed: int) -> None:
    """Damage one file, read, and put all files back."""
    rng = random.Random(seed)
    name = rng.choice(sorted(target.damaged))
    sound = {each: (target.folder / each).read_bytes() for each in target.damaged}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pillow and NumPy about odd values, of zipfile about doubled names
            (target.folder / name).write_bytes(target.damaged[name](rng, sound[name]))
            with bounded():
                target.read(target.folder)
    except ERRORS as error:
        assert str(error).strip(), "an error must say something"
    except BaseException as error:
        error.add_note(f"seed {seed}, {name} damaged") if hasattr(error, "add_note") else None
        raise
    finally:
        for each, content in sound.items():
            (target.folder / each).write_bytes(content)


@pytest.mark.parametrize("kind", TARGETS)
def test_damaged_files_are_read_or_refused(kind: str, tmp_path, request: pytest.FixtureRequest) -> None:
    target = TARGETS[kind](tmp_path)
    target.read(target.folder)  # sound files are read
    examples = request.config.getoption("--fuzz-examples")
    start = random.randrange(2**48) if examples else 0
    for seed in range(start, start + (examples or 10)):
        attack(target, seed)
