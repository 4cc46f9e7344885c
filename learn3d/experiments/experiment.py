"""One table from beginning to end: plan, train and measure what is missing, report."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from learn3d.experiments.formats import check_page, embed, to_text, write_report
from learn3d.experiments.plan import Options, Run, plan_runs
from learn3d.experiments.pool import WORKER, carry_out_all, share_of_cores
from learn3d.experiments.report import make_report
from learn3d.experiments.state import State, found_runs, read_results, read_state
from learn3d.experiments.tables import TABLES
from learn3d.terminal import INTERRUPTED, note, say

_STAGES = {"done": "are done", "trained": "only need testing", "unfinished": "go on", "new": "are new"}


@dataclass(frozen=True)
class Call:
    """What is asked for."""

    table: str
    options: Options
    jobs: int = 1
    overwrite: bool = False
    report_only: bool = False
    page: Path | None = None
    beside_code: bool = False


def run_experiment(call: Call, *, worker: Sequence[str] = WORKER) -> int:
    """Carry out a table's missing runs and write its report; the exit status: 0, 1 where a run failed, 130 if stopped.

    The report is written in any case, with what there is. Raises ValueError for a table, method or option that does not
    exist, for a page without a place for the table, for runs with other options in the output folder (unless
    `overwrite`), and for damaged files; OSError for a page that cannot be replaced.
    """
    if call.table not in TABLES:
        raise ValueError(f"there is no table {call.table!r}; choose one of {', '.join(TABLES)} (see --list)")
    if call.jobs < 1:
        raise ValueError(f"jobs must be a number of processes, at least 1, got {call.jobs}")
    if call.report_only and call.overwrite:
        raise ValueError("--report-only trains nothing and --overwrite trains anew; give one of them")
    if call.report_only and call.options.changes:
        raise ValueError("--report-only reports runs with whatever settings they have; leave --set out")
    if call.page is not None:
        check_page(call.page, call.table)
    table, failed = TABLES[call.table], {}
    if call.report_only:
        runs = found_runs(table, call.options)
    else:
        threads = call.options.threads or share_of_cores(call.jobs)
        runs = plan_runs(table, dataclasses.replace(call.options, threads=threads))
        failed = _complete(runs, call, threads, worker)
    report = make_report(table, call.options, runs, read_results(runs), beside_code=call.beside_code)
    paths = write_report(call.options.output, report)
    if call.page is not None:
        embed(call.page, report)
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


def _complete(runs: Sequence[Run], call: Call, threads: int, worker: Sequence[str]) -> dict[str, str]:
    """Train and measure what is not done yet; runs with other options are an error, or replaced."""
    states, conflicts = {}, {}
    for run in runs:
        try:
            states[run.folder] = read_state(run).stage
        except ValueError as error:
            conflicts[run.folder], states[run.folder] = error, State("new").stage
    if conflicts and not call.overwrite:
        advice = "ask for the same options, choose another --output, or give --overwrite"
        raise ValueError("\n  ".join([*map(str, conflicts.values()), advice]))
    stages = list(states.values())
    counts = ", ".join(f"{stages.count(stage)} {text}" for stage, text in _STAGES.items() if stage in stages)
    note(f"{call.table}: {len(runs)} runs, of which {counts}; {call.jobs} at a time, {threads} threads each")
    missing = [run for run in runs if states[run.folder] != "done"]
    fresh = [run for run in runs if run.folder in conflicts]
    return carry_out_all(missing, jobs=call.jobs, threads=threads, fresh=fresh, worker=worker)


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
