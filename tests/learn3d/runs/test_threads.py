"""The number of threads of a training: one or all, by the time of its steps."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable

import pytest
import torch

from learn3d import training
from learn3d.methods.pose_invariant import PoseInvariant
from learn3d.runs import checkpoint, threads
from learn3d.runs.threads import SLOWER, TRIAL, WINDOW, ThreadTuner
from learn3d.training import train


@pytest.fixture
def many_cores(monkeypatch) -> None:
    """A machine of 16 cores on which nothing fixes the number of threads."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 16)
    monkeypatch.setattr(threads, "cores", lambda: 16)


class Machine:
    """Steps that take as long as `seconds` says for a number of threads."""

    def __init__(self, **options: object) -> None:
        self.tuner = ThreadTuner(options.pop("threads", None), set_num_threads=self.set_num_threads, **options)

    def set_num_threads(self, count: int) -> None:
        self.count = count

    def run(self, steps: int, seconds: Callable[[int], float]) -> list[str]:
        """The lines for the log."""
        return [line for _ in range(steps) if (line := self.tuner.after_step(seconds(self.count)))]


def quiet(count: int) -> float:
    return 0.4 / count


def busy(count: int) -> float:
    return 0.9 if count > 1 else 0.06


@pytest.mark.parametrize(
    ("seconds", "chosen", "line"),
    [
        (quiet, 16, "threads: 16 (25 ms a step; with 1: 400 ms a step); --threads fixes it"),
        (busy, 1, "threads: 1 (60 ms a step; with 16: 900 ms a step); --threads fixes it"),
    ],
)
def test_the_faster_of_one_and_all_is_taken(many_cores, seconds, chosen: int, line: str) -> None:
    machine = Machine()
    assert (str(machine.tuner), machine.tuner.chosen) == ("16 threads or 1, whichever is faster", None)
    assert machine.run(2 * TRIAL, seconds) == [line]
    assert (machine.count, machine.tuner.chosen, str(machine.tuner)) == (chosen, chosen, f"{chosen} threads")
    assert machine.run(500, seconds) == [], "steps as fast as before change nothing"


def test_a_first_step_that_prepares_everything_does_not_count(many_cores) -> None:
    machine = Machine()
    machine.run(1, lambda count: 60.0)
    machine.run(2 * TRIAL - 1, quiet)
    assert machine.count == 16


def test_steps_that_take_turns_are_compared_in_pairs(many_cores) -> None:
    """Odd steps take long with all threads, even ones with one thread; all are faster in the mean."""
    machine, number = Machine(), iter(range(100))
    machine.run(2 * TRIAL, lambda count: (0.3 if next(number) % 2 else 0.1) * (2 if count == 1 else 1))
    assert machine.count == 16


def test_both_are_tried_again_when_steps_become_slow_and_not_before(many_cores) -> None:
    machine = Machine()
    machine.run(2 * TRIAL + WINDOW, quiet)
    assert machine.run(100, lambda count: 0.9 * SLOWER * quiet(count)) == [], "not slow enough"
    assert machine.run(WINDOW // 2, busy) == [], "a few slow steps change nothing"
    machine.run(WINDOW, quiet)
    said = machine.run(WINDOW + 2 * TRIAL, busy)
    assert machine.count == 1 and len(said) == 1


def test_one_thread_gives_way_when_the_cores_are_free_again(many_cores) -> None:
    machine = Machine()
    machine.run(2 * TRIAL, busy)
    assert machine.run(threads.REST - 1, quiet) == []
    assert len(machine.run(2 * TRIAL, quiet)) == 1
    assert machine.count == 16


def test_a_trial_that_is_hopeless_ends_early(many_cores) -> None:
    machine = Machine()
    assert machine.run(TRIAL + 2, quiet), "two steps with one thread are enough to see that all are faster"


@pytest.mark.parametrize("fixed", ["option", "environment", "core", "processes"])
def test_a_fixed_number_stays(many_cores, monkeypatch, fixed: str) -> None:
    options = {"option": {"threads": 4}, "processes": {"processes": 2}}.get(fixed, {})
    if fixed == "environment":
        monkeypatch.setenv("OMP_NUM_THREADS", "16")
    if fixed == "core":
        monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    machine = Machine(**options)
    machine.tuner.resume(2)
    assert machine.run(100, busy) == []
    wanted = {"option": 4, "core": 1}.get(fixed, 16)
    assert (machine.count, machine.tuner.chosen) == (wanted, None)


@pytest.mark.parametrize(
    ("count", "processes", "warned"), [(17, 1, True), (16, 1, False), (1, 64, False), (9, 2, True)]
)
def test_more_threads_than_cores_are_named(many_cores, count: int, processes: int, warned: bool) -> None:
    machine = Machine(threads=count, processes=processes)
    assert ("--threads" in machine.tuner.oversubscription_warning(processes)) == warned


def test_a_resumed_run_keeps_its_number(tiny_run, run_folder, monkeypatch) -> None:
    """The number is in the checkpoint, and is not tried again while the machine has as many cores."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    used, take_step = [], PoseInvariant.take_step
    monkeypatch.setattr(torch, "set_num_threads", used.append)
    tuner = lambda *arguments, **options: ThreadTuner(*arguments, set_num_threads=used.append, **options)  # noqa: E731
    monkeypatch.setattr(training, "ThreadTuner", tuner)

    def slow_with_two(self, batch, step: int):
        time.sleep(0.3 if used[-1] == 2 else 0.0)
        return take_step(self, batch, step)

    monkeypatch.setattr(PoseInvariant, "take_step", slow_with_two)
    train(tiny_run(run_folder, iterations=2 * TRIAL, threads=None))
    assert used == [2, 1, 1]
    assert checkpoint.load_metadata(run_folder / "last.safetensors").progress.threads == 1
    assert "threads: 1 (" in (run_folder / "journal.txt").read_text()
    used.clear()
    train(tiny_run(run_folder, iterations=2 * TRIAL + 3, threads=None), resume=True)
    assert used == [2, 1], "all while the data are read, then the number of the checkpoint"
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    train(tiny_run(run_folder, iterations=2 * TRIAL + 4, threads=3), resume=True)
    assert used[-1] == 3, "unless another one is asked for"


def _spin(seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        pass


@pytest.mark.slow
@pytest.mark.skipif(threads.cores() < 2, reason="needs two cores")
def test_on_busy_cores_the_steps_are_about_as_fast_as_with_one_thread(tiny_config, run_folder, monkeypatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before, seconds = torch.get_num_threads(), {}
    load = [multiprocessing.get_context("spawn").Process(target=_spin, args=(300,)) for _ in range(3 * threads.cores())]
    for process in load:
        process.start()
    options = {"preset": "plus-kato", "batch_size": 16, "iterations": 24, "validate_every": 1000, "bank_size": 64}
    try:
        for count in (1, None):
            torch.set_num_threads(threads.cores())
            config = tiny_config(run_folder / str(count), threads=count, encoder="conv-light", **options)
            seconds[count] = train(config).seconds
    finally:
        torch.set_num_threads(before)
        for process in load:
            process.kill()
            process.join()
    chosen = checkpoint.load_metadata(run_folder / "None" / "last.safetensors").progress.threads
    assert chosen in (1, threads.cores())
    assert seconds[None] < 3 * seconds[1], f"{seconds}, chosen: {chosen}"
