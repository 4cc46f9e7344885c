"""One table from beginning to end: plan, train and measure what is missing, report."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from learn3d.device import cores
from learn3d.experiments.formats import to_text, write_report
from learn3d.experiments.plan import Options, Run, plan_runs
from learn3d.experiments.pool import Work, carry_out, carry_out_all
from learn3d.experiments.report import make_report
from learn3d.experiments.results import conflicts_with, read_results
from learn3d.experiments.tables import TABLES
from learn3d.terminal import INTERRUPTED, note, say


@dataclass(frozen=True)
class Call:
    """What is asked for."""

    table: str
    options: Options
    jobs: int = 1
    overwrite: bool = False
    report_only: bool = False


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
    threads = call.options.threads or max(1, cores() // call.jobs)
    runs = plan_runs(table, dataclasses.replace(call.options, threads=threads))
    if not call.report_only:
        failed = _complete(runs, call, threads, work)
    report = make_report(table, call.options, runs, read_results(runs))
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
    note(
        f"{call.table}: {len(runs)} runs, of which {len(done)} are done; {call.jobs} at a time, {threads} threads each"
    )
    missing = [run for run in runs if run.folder not in done]
    fresh = [run for run in runs if run.name in conflicts]
    return carry_out_all(missing, jobs=call.jobs, fresh=fresh, work=work)


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
