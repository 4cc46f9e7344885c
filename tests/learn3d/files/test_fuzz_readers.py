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
from fuzz_targets import ERRORS, TARGETS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from memory_checks import at_most
from mutations import Target

MIB = 2**20
SECONDS = 20  # an example that takes longer is a hang
MEMORY = 400 * MIB  # that Python and NumPy may hold at a time


class Hang(BaseException):
    """No Exception, so that no reader takes it for one of its own."""


@pytest.fixture(scope="module", params=TARGETS)
def target(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Target:
    return TARGETS[request.param](tmp_path_factory.mktemp("target"))


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Fail where the block takes too long or too much memory."""

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
    """Damage one file, read, and put the file back."""
    rng = random.Random(seed)
    name = rng.choice(sorted(target.damaged))
    path = target.folder / name
    sound = path.read_bytes()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of Pillow and NumPy about odd values, of zipfile about doubled names
            path.write_bytes(target.damaged[name](rng, sound))
            with bounded():
                target.read(target.folder)
    except ERRORS as error:
        assert str(error).strip(), "an error must say something"
    finally:
        path.write_bytes(sound)


def test_sound_files_are_read(target: Target) -> None:
    target.read(target.folder)


def test_damaged_files_are_read_or_refused(target: Target, request: pytest.FixtureRequest) -> None:
    examples = request.config.getoption("--fuzz-examples")
    few = examples == 0

    @settings(
        max_examples=examples or 10,
        derandomize=few,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.integers(0, 2**48))
    def run(seed: int) -> None:
        attack(target, seed)

    run()
