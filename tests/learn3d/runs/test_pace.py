"""The warning about threads that do not get the cores they ask for."""

from __future__ import annotations

from pathlib import Path

import pytest

from learn3d import training
from learn3d.runs.pace import CoreShare


class Clocks:
    """Time that passes, and CPU time, as told."""

    def __init__(self) -> None:
        self.now, self.cpu = 1000.0, 50.0

    def watch(self, threads: int, **options: int) -> CoreShare:
        clocks = {"clock": lambda: self.now, "cpu_clock": lambda: self.cpu}
        return CoreShare(threads, seconds=10, cores=16, **clocks, **options)

    def steps(self, watched: CoreShare, count: int, *, cores: float) -> list[str]:
        """What is said during steps of one second in which `cores` cores work."""
        said = []
        for _ in range(count):
            self.now += 1
            self.cpu += cores
            said.append(watched.warning())
        return [text for text in said if text is not None]


def test_threads_that_share_their_cores_are_named_once() -> None:
    clocks = Clocks()
    watched = clocks.watch(2)
    (text,) = clocks.steps(watched, 100, cores=1.3)
    assert text.startswith("2 threads got the time of 1.3 of ")
    assert text.endswith("--threads 1")


@pytest.mark.parametrize(("threads", "cores", "advice"), [(16, 3.9, 4), (16, 7.0, 7), (2, 0.4, 1), (4, 2.8, 3)])
def test_the_advice_is_the_number_of_cores_that_there_were(threads: int, cores: float, advice: int) -> None:
    clocks = Clocks()
    (text,) = clocks.steps(clocks.watch(threads), 20, cores=cores)
    assert text.endswith(f"--threads {advice}")


@pytest.mark.parametrize(("threads", "cores"), [(2, 1.9), (2, 1.6), (16, 13.0), (1, 0.1)])
def test_a_run_that_has_its_cores_hears_nothing(threads: int, cores: float) -> None:
    clocks = Clocks()
    assert clocks.steps(clocks.watch(threads), 100, cores=cores) == []


def test_neither_the_first_steps_nor_later_ones_count() -> None:
    clocks = Clocks()
    watched = clocks.watch(2)
    assert clocks.steps(watched, 1, cores=0.1) == [], "memory is allocated"
    assert clocks.steps(watched, 12, cores=2) == []
    assert clocks.steps(watched, 100, cores=0.1) == [], "a warning in the middle of the night helps nobody"


def test_more_threads_than_cores_are_named_at_once() -> None:
    clocks = Clocks()
    assert clocks.steps(clocks.watch(17), 5, cores=16) == [
        "17 threads on 16 cores wait for each other; stop with Ctrl-C and continue with --threads 16"
    ]


@pytest.mark.parametrize(
    ("processes", "threads", "said"),
    [
        (4, 4, []),
        (16, 1, []),
        (
            4,
            5,
            [
                "4 processes of 5 threads each on 16 cores wait for each other; "
                "stop with Ctrl-C and continue with --threads 4"
            ],
        ),
        (
            17,
            1,
            [
                "17 processes of 1 thread each on 16 cores wait for each other; "
                "stop with Ctrl-C and continue with fewer processes"
            ],
        ),
    ],
)
def test_processes_share_the_cores_and_may_wait_for_each_other(processes: int, threads: int, said: list[str]) -> None:
    clocks = Clocks()
    assert clocks.steps(clocks.watch(threads, processes=processes, waits=True), 100, cores=0.5) == said


def test_a_run_says_it(tiny_run, run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Hungry(CoreShare):
        def __init__(self, threads: int, **given: int) -> None:
            super().__init__(
                threads,
                **given,
                seconds=1,
                skipped_steps=0,
                cores=2,
                clock=iter(range(99)).__next__,
                cpu_clock=lambda: 0.0,
            )

    monkeypatch.setattr(training, "CoreShare", Hungry)
    training.train(tiny_run(run_folder, threads=2, iterations=2))
    journal = (run_folder / "journal.txt").read_text()
    assert journal.count("warning: 2 threads got the time of 0.0 of ") == 1
