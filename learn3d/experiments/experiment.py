"""One table from beginning to end: plan its runs, train and test the missing ones, write the report."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from pydantic import ValidationError

from learn3d.config import config_from_dict, differences, load_config
from learn3d.distributed.tasks import Task, run_tasks
from learn3d.experiments.formats import to_text, write_report
from learn3d.experiments.measurement import Result, measure
from learn3d.experiments.plan import PlannedRun, Request, plan_runs
from learn3d.experiments.report import make_report
from learn3d.experiments.tables import TABLES, VARIANTS
from learn3d.files import limits, writing
from learn3d.files.reading import parse_json, read_bytes
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.runs.threads import cores
from learn3d.terminal import INTERRUPTED, note, say
from learn3d.training import train

LOG_FILE, RESULT_FILE = "log.txt", "test.json"  # in a run's folder

#: Trains and tests a run, anew if the second argument is true; returns False if it was stopped.
Work = Callable[[PlannedRun, bool], bool]


def train_and_test(run: PlannedRun, fresh: bool) -> bool:
    """Train, measure and write test.json; False if a signal stopped the training. Raises as `train` and `measure` do.

    An existing run goes on, unless `fresh` replaces it. If it only needs measuring, `train` checks that it is complete
    and of the same options and data.
    """
    resume = not fresh and run_folder.is_run(run.folder)
    if not resume:
        (run.folder / RESULT_FILE).unlink(missing_ok=True)
    if not train(run.config, resume=resume, overwrite=not resume).finished:
        return False
    file = checkpoint.find(run.folder, run.checkpoint)
    result = measure(file, data=run.config.data, device=run.config.device)
    writing.write_json(run.folder / RESULT_FILE, result.model_dump())
    print(f"tested: voxel IoU {result.voxel_iou_kato18:.4f} (kato18)", flush=True)
    return True


def run_experiment(request: Request, *, work: Work = train_and_test) -> int:
    """Carry out a table's missing runs and write its report; the exit status: 0, 1 if a run failed, 130 if stopped.

    The report is written in any case, from the results so far. Raises ValueError for a method or option that does not
    exist, for runs with other options in the output folder (unless `overwrite`), and for damaged files.
    """
    threads = request.threads or max(1, min(cores(), torch.get_num_threads()) // request.jobs)
    runs, failed = plan_runs(dataclasses.replace(request, threads=threads)), {}
    conflicts = {run.name: text for run in runs if (text := find_conflict(run))}
    if not request.report_only:
        if conflicts and not request.overwrite:
            advice = "ask for the same options, choose another --output, or give --overwrite"
            raise ValueError("\n  ".join([*conflicts.values(), advice]))
        failed = _complete(runs, conflicts, request, threads, work)
        conflicts = {run.name: text for run in runs if (text := find_conflict(run))}
    for text in conflicts.values():
        note(f"left out: {text}")
    report = make_report(request, runs, read_results([run for run in runs if run.name not in conflicts]))
    paths = write_report(request.output, report)
    say(to_text(report))
    note("report: " + ", ".join(map(str, paths)))
    for name, tail in failed.items():
        note(f"\nFAILED {name}; the end of its log:\n{tail}")
    if failed:
        note(f"\n{len(failed)} of {len(runs)} runs failed; the same command tries them again")
        return 1
    if report["missing"] and not request.report_only:
        note("stopped; the same command goes on")
        return INTERRUPTED
    return 0


def _complete(
    runs: Sequence[PlannedRun], conflicts: dict[str, str], request: Request, threads: int, work: Work
) -> dict[str, str]:
    """Train and test the missing runs, and replace those in conflict; returns the end of each failed run's log."""
    done = read_results([run for run in runs if run.name not in conflicts])
    where = f"on the cluster {request.cluster}" if request.cluster else f"{request.jobs} at a time"
    logs = request.output / "runs/*/*" / LOG_FILE
    note(f"{request.table}: {len(runs)} runs, {len(done)} of them done; {where}, {threads} threads each; logs: {logs}")
    tasks = [
        Task(run.name, work, (run, run.name in conflicts), run.folder / LOG_FILE)
        for run in runs
        if run.folder not in done
    ]
    return run_tasks(tasks, jobs=request.jobs, cluster=request.cluster)


def read_result(path: Path) -> Result:
    """Read a test.json; ValueError naming it if it is damaged or holds something else."""
    content = read_bytes(path, limits.JSON_BYTES, "the measurement of a run as JSON")
    try:
        return Result.model_validate(parse_json(content))
    except ValueError as error:
        reason = error
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            reason = f"{'.'.join(map(str, first['loc'])) or 'it'}: {first['msg']}"
        raise ValueError(f"{path} is no measurement of a run ({reason}); remove it, and it is made again") from None


def read_results(runs: Sequence[PlannedRun]) -> dict[Path, Result]:
    """The stored results of these runs by folder, if they are of this checkpoint, length of training and data."""
    results = {}
    for run in runs:
        if (path := run.folder / RESULT_FILE).is_file():
            result, data = read_result(path), str(run.config.data.resolve())
            stored = (result.iterations, Path(result.checkpoint).stem, result.data)
            if stored == (run.config.iterations, run.checkpoint, data):
                results[run.folder] = result
    return results


def find_conflict(run: PlannedRun) -> str:
    """The options in which the run in the folder differs from the planned one, as a sentence; "" if it can go on."""
    if run_folder.is_run(run.folder):
        saved = load_config(run.folder / run_folder.CONFIG)
    elif (path := run.folder / RESULT_FILE).is_file():
        saved = config_from_dict(read_result(path).config, str(path))
    else:
        return ""
    changed = differences(run.config, saved)
    if run.checkpoint == "best" and run.config.val_split != saved.val_split:
        changed.append(
            f"val_split: {saved.val_split!r} chose the run's best networks, {run.config.val_split!r} asked for"
        )
    return f"{run.folder} has a run with other options: " + "; ".join(changed) if changed else ""


def describe_tables() -> str:
    """Every table with its methods, for --list."""
    lines = []
    for name, table in TABLES.items():
        lines += [
            f"{name}: {table.title}",
            f"  layout {table.layout}, {len(table.categories)} categories, seeds {table.seeds}",
        ]
        for label, variant in table.rows.items():
            about = "quoted"
            if variant:
                changes = "".join(f", {option}={value}" for option, value in VARIANTS[variant].changes.items())
                about = f"{variant}, preset {VARIANTS[variant].preset}{changes}"
            lines.append(f"  {label}: {about}")
    return "\n".join(lines)
