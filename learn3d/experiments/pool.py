"""Several runs at a time, each in a process of its own with its share of the cores, its output in <run>/log.txt."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from learn3d.experiments.plan import LOG_FILE, Run
from learn3d.experiments.worker import STOPPED, request_of
from learn3d.interrupt import handled_by
from learn3d.terminal import note

#: Python puts the working directory first on its path, where a source folder would hide the installed package.
NOT_FROM_HERE = "import sys; sys.path[:1] = [] if sys.path[0] == '' else sys.path[:1]; "
WORKER = (sys.executable, "-c", NOT_FROM_HERE + "from learn3d.experiments.worker import main; sys.exit(main())")
TAIL_LINES = 5  # of a failed run's log, shown at the end
SECONDS_BETWEEN_LINES = 60.0
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    run: Run
    status: str  # "done", "failed", or "stopped" (it can go on)
    seconds: float
    tail: str = ""  # last lines of a failed run's log


@dataclass
class _Job:
    run: Run
    process: subprocess.Popen[bytes]
    started: float
    log_start: int  # length of log.txt when it started

    def new_lines(self) -> list[str]:
        """What the log has received from this process."""
        with open(self.run.folder / LOG_FILE, "rb") as file:
            file.seek(max(self.log_start, file.seek(0, os.SEEK_END) - 10_000))
            return [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]


def carry_out_all(
    runs: Sequence[Run],
    *,
    jobs: int,
    threads: int,
    fresh: Sequence[Run] = (),
    worker: Sequence[str] = WORKER,
    say: Callable[[str], None] = note,
) -> list[Outcome]:
    """Carry out `runs`, at most `jobs` at a time, with `threads` threads each; those in `fresh` start anew.

    A failing run does not stop the others. SIGINT, SIGTERM or SIGHUP stop all of them: each saves its state, nothing
    new is started, and what was running counts as stopped; a second SIGINT ends them at once. Outcomes are in the order
    of `runs`; those that were never started are not among them.
    """
    waiting, running, outcomes = list(runs), [], {}
    last_report = time.monotonic()
    received, told = [], 0  # a SIGTERM or SIGHUP after the first signal is the same request again, not a second one
    with handled_by(lambda n: received.append(n) if not received or n == signal.SIGINT else None):
        while (waiting and not received) or running:
            while waiting and not received and len(running) < jobs:
                run = waiting.pop(0)
                running.append(_start(run, run in fresh, threads, worker))
                say(f"[{len(outcomes) + len(running)}/{len(runs)}] {run.name}: started, log in {run.folder / LOG_FILE}")
            while told < len(received):
                _tell(running, kill=told > 0)
                say("stopping: the runs save their state (once more: end them at once)" if told == 0 else "ending")
                told += 1
            for job in [job for job in running if job.process.poll() is not None]:
                running.remove(job)
                outcome = _finish(job, stopping=bool(received))
                outcomes[job.run.folder] = outcome
                last = job.new_lines()[-1:] or [""]
                say(f"{job.run.name}: {outcome.status} after {_duration(outcome.seconds)}; {last[0]}")
            if running and time.monotonic() - last_report >= SECONDS_BETWEEN_LINES:
                last_report = time.monotonic()
                for job in running:
                    say(f"  {job.run.name}: " + (job.new_lines()[-1:] or ["..."])[0])
            time.sleep(0.1)
    return [outcomes[run.folder] for run in runs if run.folder in outcomes]


def share_of_cores(jobs: int) -> int:
    """Threads for each of `jobs` processes on this machine, at least 1."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // jobs)


def _start(run: Run, fresh: bool, threads: int, worker: Sequence[str]) -> _Job:
    """Start a worker in a session of its own, so that Ctrl-C at the terminal reaches it through us alone."""
    run.folder.mkdir(parents=True, exist_ok=True)
    package = str(Path(__file__).parents[2])
    environment = os.environ | dict.fromkeys(_THREAD_VARIABLES, str(threads)) | {"PYTHONUNBUFFERED": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))
    with open(run.folder / LOG_FILE, "ab") as log:
        start = log.tell()
        process = subprocess.Popen(
            worker,
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
    with contextlib.suppress(BrokenPipeError):  # it ended at once: its log says why
        process.stdin.write(request_of(run, fresh=fresh).encode() + b"\n")
        process.stdin.flush()  # and stays open: see `worker`
    return _Job(run, process, time.monotonic(), start)


def _finish(job: _Job, stopping: bool) -> Outcome:
    with contextlib.suppress(BrokenPipeError):
        job.process.stdin.close()
    code, seconds = job.process.returncode, time.monotonic() - job.started
    if code == 0:
        return Outcome(job.run, "done", seconds)
    if code == STOPPED or stopping:
        return Outcome(job.run, "stopped", seconds)
    lines = job.new_lines()[-TAIL_LINES:]
    if code < 0:
        lines.append(f"(ended by {signal.Signals(-code).name})")
    return Outcome(job.run, "failed", seconds, "\n".join(lines))


def _tell(running: Sequence[_Job], kill: bool) -> None:
    for job in running:
        with contextlib.suppress(ProcessLookupError):
            job.process.send_signal(signal.SIGKILL if kill else signal.SIGINT)


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"
