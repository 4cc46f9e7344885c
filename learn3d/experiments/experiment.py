"""One table from beginning to end: plan, train and measure what is missing, report."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from learn3d.device import cores
from learn3d.distributed.tasks import Task, run_tasks
from learn3d.experiments import results
from learn3d.experiments.formats import to_text, write_report
from learn3d.experiments.plan import Options, Run, plan_runs
from learn3d.experiments.report import make_report
from learn3d.experiments.results import conflicts_with, read_results
from learn3d.experiments.tables import TABLES
from learn3d.runs import folder as run_folder
from learn3d.terminal import INTERRUPTED, note, say
from learn3d.training import train

LOG_FILE = "log.txt"  # in a run's folder

#: Carries out a run, anew if the second argument says so; False where it was stopped.
Work = Callable[[Run, bool], bool]


@dataclass(frozen=True)
class Call:
    """What is asked for."""

    table: str
    options: Options
    jobs: int = 1
    cluster: str | None = None
    overwrite: bool = False
    report_only: bool = False


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


def run_experiment(call: Call, *, work: Work = carry_out) -> int:
    """Carry out a table's missing runs and write its report; the exit status: 0, 1 where a run failed, 130 if stopped.

    The report is written in any case, with what there is. Raises ValueError for a table, method or option that does not
    exist, for runs with other options in the output folder (unless `overwrite`), and for damaged files.
    """
    if call.table not in TABLES:
        raise ValueError(f"there is no table {call.table!r}; choose one of {', '.join(TABLES)} (see --list)")
    if call.jobs < 1:
        raise ValueError(f"jobs must be a number of processes, at least 1, got {call.jobs}")
    if call.report_only and call.overwrite:
        raise ValueError("--report-only trains nothing and --overwrite trains anew; give one of them")
    table, failed = TABLES[call.table], {}
    threads = call.options.threads or max(1, min(cores(), torch.get_num_threads()) // call.jobs)
    runs = plan_runs(table, dataclasses.replace(call.options, threads=threads))
    if not call.report_only:
        failed = _complete(runs, call, threads, work)
    unlike = {run.name: text for run in runs if (text := conflicts_with(run))}
    for text in unlike.values():
        note(f"left out: {text}")
    report = make_report(table, call.options, runs, read_results([run for run in runs if run.name not in unlike]))
    paths = write_report(call.options.output, report)
    say(to_text(report))
    note("report: " + ", ".join(map(str, paths)))
    for name, tail in failed.items():
        note(f"\nFAILED {name}; the end of its log:\n{tail}")
    if failed:
        note(f"\n{len(failed)} of {len(runs)} runs failed; the same command tries them again")
        return 1
    if report["missing"] and not call.report_only:
        note("stopped; the same command goes on")
        return INTERRUPTED
    return 0


def _complete(runs: Sequence[Run], call: Call, threads: int, work: Work) -> dict[str, str]:
    """Train and measure what is not done yet; runs with other options are an error, or replaced."""
    conflicts = {run.name: text for run in runs if (text := conflicts_with(run))}
    if conflicts and not call.overwrite:
        advice = "ask for the same options, choose another --output, or give --overwrite"
        raise ValueError("\n  ".join([*conflicts.values(), advice]))
    done = read_results([run for run in runs if run.name not in conflicts])
    where = f"on the cluster {call.cluster}" if call.cluster else f"{call.jobs} at a time"
    logs = call.options.output / "runs/*/*" / LOG_FILE
    note(
        f"{call.table}: {len(runs)} runs, of which {len(done)} are done; {where}, {threads} threads each; logs: {logs}"
    )
    tasks = [
        Task(run.name, work, (run, run.name in conflicts), run.folder / LOG_FILE)
        for run in runs
        if run.folder not in done
    ]
    return run_tasks(tasks, call.options.output, jobs=call.jobs, cluster=call.cluster)


def describe_tables() -> str:
    """What --list prints: every table with its methods."""
    lines = []
    for table in TABLES.values():
        lines.append(f"{table.name}: {table.title}")
        lines.append(f"  layout {table.layout}, {len(table.categories)} categories, seeds {table.seeds}")
        for row in table.rows:
            changes = "".join(f", {name}={value}" for name, value in row.variant.changes.items()) if row.variant else ""
            what = f"{row.variant.name}, preset {row.variant.preset}{changes}" if row.variant else "quoted"
            lines.append(f"  {row.label}: {what}")
    return "\n".join(lines)
