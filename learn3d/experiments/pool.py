"""Several runs at a time, each in a process of its own with its share of the cores, its output in <run>/log.txt."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.process import BaseProcess

from learn3d.experiments import results
from learn3d.experiments.plan import Run
from learn3d.runs import folder as run_folder
from learn3d.terminal import handled_by, note
from learn3d.training import train

LOG_FILE = "log.txt"
STOPPED = 75  # exit status of a run that was stopped and can go on (sysexits' EX_TEMPFAIL)
TAIL_LINES = 5  # of a failed run's log, shown at the end
SECONDS_BETWEEN_LINES = 60.0

#: Carries out a run, anew if the second argument says so; False where it was stopped.
Work = Callable[[Run, bool], bool]


def carry_out(run: Run, fresh: bool) -> bool:
    """Train and measure; False when a signal stopped the training. Raises what `train` and `measure` raise.

    A run that is there goes on, unless `fresh` replaces it. If it only needs measuring, `train` finds that it is
    complete and still of the same options and data.
    """
    resume = not fresh and run_folder.is_run(run.folder)
    if not resume:
        (run.folder / results.RESULT_FILE).unlink(missing_ok=True)
    if not train(run.config, resume=resume, overwrite=not resume).finished:
        return False
    record = results.measure(run)
    print(f"tested: voxel IoU {record['voxel_iou_kato18']:.4f} (kato18)", flush=True)
    return True


def carry_out_all(
    runs: Sequence[Run],
    *,
    jobs: int,
    fresh: Sequence[Run] = (),
    work: Work = carry_out,
    say: Callable[[str], None] = note,
) -> dict[str, str]:
    """Carry out `runs`, at most `jobs` at a time; those in `fresh` start anew.

    A failing run does not stop the others. SIGINT, SIGTERM or SIGHUP stop all of them: each saves its state, nothing
    new is started, and what was running counts as stopped; a second SIGINT ends them at once. Returns the end of the
    log of every run that failed, by the run's name.
    """
    waiting, running, failed = list(runs), [], {}
    received, stopping, last_report = [], False, time.monotonic()
    with handled_by(received.append):
        while (waiting and not received) or running:
            while waiting and not received and len(running) < jobs:
                run = waiting.pop(0)
                running.append((run, _start(run, run in fresh, work), time.monotonic()))
                say(f"[{len(runs) - len(waiting)}/{len(runs)}] {run.name}: started, log in {run.folder / LOG_FILE}")
            if received and not stopping:
                stopping = True
                say("stopping: the runs save their state (once more: end them at once)")
                for _, process, _ in running:
                    process.terminate()  # not SIGINT: Ctrl-C has sent that already, and a second one ends at once
            if signal.SIGINT in received[1:]:
                for _, process, _ in running:
                    process.kill()
            for job in [job for job in running if not job[1].is_alive()]:
                running.remove(job)
                run, process, started = job
                status = "done" if process.exitcode == 0 else "failed"
                if process.exitcode == STOPPED or (stopping and status == "failed"):
                    status = "stopped"
                say(f"{run.name}: {status} after {(time.monotonic() - started) / 60:.1f} min; {_tail(run)[-1]}")
                if status == "failed":
                    failed[run.name] = _reason(run, process)
            if running and time.monotonic() - last_report >= SECONDS_BETWEEN_LINES:
                last_report = time.monotonic()
                for run, *_ in running:
                    say(f"  {run.name}: {_tail(run)[-1]}")
            time.sleep(0.1)
    return failed


def _start(run: Run, fresh: bool, work: Work) -> BaseProcess:
    run.folder.mkdir(parents=True, exist_ok=True)
    process = multiprocessing.get_context("spawn").Process(target=_in_process, args=(run, fresh, work))
    process.start()
    return process


def _in_process(run: Run, fresh: bool, work: Work) -> None:
    """What a run's process does: `work`, with all that it says in the log."""
    with open(run.folder / LOG_FILE, "ab") as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())
    threading.Thread(target=_stop_with_parent, daemon=True).start()
    try:
        finished = work(run, fresh)
    except (ValueError, OSError, FloatingPointError, MemoryError) as error:
        note(f"error: {error}")
        sys.exit(1)
    except KeyboardInterrupt:  # before or after the training, which saves by itself
        finished = False
    sys.exit(0 if finished else STOPPED)


def _stop_with_parent() -> None:
    """Ask this process to save its state and to end when its parent is gone, for whatever reason."""
    multiprocessing.parent_process().join()
    os.kill(os.getpid(), signal.SIGTERM)


def _tail(run: Run) -> list[str]:
    """The last lines of a run's log."""
    path = run.folder / LOG_FILE
    text = path.read_text(errors="replace") if path.is_file() else ""
    return [line.strip() for line in text.splitlines() if line.strip()][-TAIL_LINES:] or ["..."]


def _reason(run: Run, process: BaseProcess) -> str:
    """Why a run failed: the end of its log, and the signal that ended it."""
    killed = [f"(ended by {signal.Signals(-process.exitcode).name})"] if process.exitcode < 0 else []
    return "\n".join([*_tail(run), *killed])
