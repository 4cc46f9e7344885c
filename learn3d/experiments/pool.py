"""Several runs at a time, each in a process of its own with its share of the cores, its output in <run>/log.txt."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from learn3d.experiments.plan import Run
from learn3d.experiments.worker import STOPPED, request_of
from learn3d.terminal import handled_by, note

LOG_FILE = "log.txt"
#: Python puts the working directory first on its path, where a source folder would hide the installed package.
NOT_FROM_HERE = "import sys; sys.path[:1] = [] if sys.path[0] == '' else sys.path[:1]; "
WORKER = (sys.executable, "-c", NOT_FROM_HERE + "from learn3d.experiments.worker import main; sys.exit(main())")
TAIL_LINES = 5  # of a failed run's log, shown at the end
SECONDS_BETWEEN_LINES = 60.0
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass
class Job:
    """A run and the process that carries it out."""

    run: Run
    process: subprocess.Popen[bytes]
    log_start: int  # length of log.txt when it started
    started: float = field(default_factory=time.monotonic)

    def lines(self) -> list[str]:
        """The last lines that the log has received from this process."""
        with open(self.run.folder / LOG_FILE, "rb") as file:
            file.seek(max(self.log_start, file.seek(0, os.SEEK_END) - 10_000))
            found = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
        return found[-TAIL_LINES:] or ["..."]

    def status(self, stopping: bool) -> str:
        """How the process, which has ended, did: "done", "failed", or "stopped" (it can go on)."""
        code = self.process.returncode
        return "done" if code == 0 else "stopped" if code == STOPPED or stopping else "failed"


def carry_out_all(
    runs: Sequence[Run],
    *,
    jobs: int,
    threads: int,
    fresh: Sequence[Run] = (),
    worker: Sequence[str] = WORKER,
    say: Callable[[str], None] = note,
) -> dict[str, str]:
    """Carry out `runs`, at most `jobs` at a time, with `threads` threads each; those in `fresh` start anew.

    A failing run does not stop the others. SIGINT, SIGTERM or SIGHUP stop all of them: each saves its state, nothing
    new is started, and what was running counts as stopped; a second SIGINT ends them at once. Returns the end of the
    log of every run that failed, by the run's name.
    """
    waiting, running, ended, failed = list(runs), [], 0, {}
    last_report = time.monotonic()
    received, told = [], 0  # a SIGTERM or SIGHUP after the first signal is the same request again, not a second one
    with handled_by(lambda n: received.append(n) if not received or n == signal.SIGINT else None):
        while (waiting and not received) or running:
            while waiting and not received and len(running) < jobs:
                run = waiting.pop(0)
                running.append(_start(run, run in fresh, threads, worker))
                say(f"[{ended + len(running)}/{len(runs)}] {run.name}: started, log in {run.folder / LOG_FILE}")
            while told < len(received):
                for job in running:
                    with contextlib.suppress(ProcessLookupError):
                        job.process.send_signal(signal.SIGKILL if told else signal.SIGINT)
                say("ending" if told else "stopping: the runs save their state (once more: end them at once)")
                told += 1
            for job in [job for job in running if job.process.poll() is not None]:
                running.remove(job)
                ended += 1
                with contextlib.suppress(BrokenPipeError):
                    job.process.stdin.close()
                status, lines = job.status(stopping=bool(received)), job.lines()
                say(f"{job.run.name}: {status} after {(time.monotonic() - job.started) / 60:.1f} min; {lines[-1]}")
                if status == "failed":
                    code = job.process.returncode
                    killed = [f"(ended by {signal.Signals(-code).name})"] if code < 0 else []
                    failed[job.run.name] = "\n".join([*lines, *killed])
            if running and time.monotonic() - last_report >= SECONDS_BETWEEN_LINES:
                last_report = time.monotonic()
                for job in running:
                    say(f"  {job.run.name}: {job.lines()[-1]}")
            time.sleep(0.1)
    return failed


def share_of_cores(jobs: int) -> int:
    """Threads for each of `jobs` processes on this machine, at least 1."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // jobs)


def _start(run: Run, fresh: bool, threads: int, worker: Sequence[str]) -> Job:
    """Start a worker in a session of its own, so that Ctrl-C at the terminal reaches it through us alone."""
    run.folder.mkdir(parents=True, exist_ok=True)
    environment = os.environ | dict.fromkeys(_THREAD_VARIABLES, str(threads)) | {"PYTHONUNBUFFERED": "1"}
    path = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, path))
    pipes = {"stdin": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with open(run.folder / LOG_FILE, "ab") as log:
        start = log.tell()
        process = subprocess.Popen(worker, stdout=log, env=environment, start_new_session=True, **pipes)
    with contextlib.suppress(BrokenPipeError):  # it ended at once: its log says why
        process.stdin.write(request_of(run, fresh=fresh).encode() + b"\n")
        process.stdin.flush()  # and stays open: see `worker`
    return Job(run, process, start)
