"""Make a table of the paper: train what it needs, measure it, and put the paper's figures beside ours.

Examples:
  learn3d experiment --list
  learn3d experiment kato --data DATA --output OUTPUT --category airplane,chair --iterations 5000 --jobs 2
  learn3d experiment ablation --data DATA --output OUTPUT --category chair --set precision=fp32
  learn3d experiment mmd --data DATA --output OUTPUT --category airplane,chair --iterations 5000 --report-only

Tables share their runs: what is complete is skipped, what was stopped goes on, also runs that `learn3d train` made in
OUTPUT/runs/<category>/<method>-seed<k>. Ctrl-C stops all of them; the same command continues.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.commands.parsing import names, parse
from learn3d.data.layouts import Layout
from learn3d.experiments.experiment import describe_tables, run_experiment
from learn3d.experiments.plan import Request
from learn3d.terminal import say

COMMON = ("table", "data", "output", "category", "methods", "iterations", "batch_size", "seeds", "jobs", "list", "set")
COMMON += ("overwrite", "report_only")


@dataclass(frozen=True)
class Command:
    """What is asked for."""

    table: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="TABLE")]]
    """Name of the table, see --list."""
    data: Path
    """Folder of the data set."""
    output: Path
    """Folder of runs and reports; all tables can share one."""
    category: str = ""
    """Categories, separated by commas, each trained by itself. None given: the table's."""
    methods: tuple[str, ...] = ()
    """Methods (rows) of the table. None given: all."""
    iterations: int | None = None
    """Training steps of every run. None given: the published number."""
    batch_size: int | None = None
    """Images per step. None given: the published number."""
    seeds: int | None = None
    """Number of seeds, 0 .. seeds - 1. None given: the table's."""
    jobs: int = 1
    """Runs at a time, each in a process of its own with its share of the cores."""
    cluster: str | None = None
    """Runs on a Dask cluster: the address or the scheduler file of its scheduler (docs/scale.md). None given: here."""
    threads: int | None = None
    """CPU threads of each run. None given: cores (or OMP_NUM_THREADS) / jobs."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run."""
    layout: Layout | None = None
    """Layout of the data set. None given: the table's."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[METHOD:]NAME=VALUE")] = ()
    """Settings and training options to change, in all methods that have them or in one."""
    overwrite: bool = False
    """Start runs anew that are there with other options."""
    report_only: bool = False
    """Train nothing: report what is done of the runs that are asked for."""
    list: bool = False
    """Show the tables and their methods, and end."""


def run(arguments: Sequence[str]) -> int:
    """Make the table; the exit status is 1 where a run failed, 130 where it was stopped."""
    if "--list" in arguments:
        say(describe_tables())
        return 0
    command = parse(Command, arguments, name="experiment", about=__doc__, common=COMMON)
    shared = ("table", "data", "output", "methods", "iterations", "batch_size", "seeds", "layout", "device", "threads")
    shared += ("jobs", "cluster", "overwrite", "report_only")
    values = {name: getattr(command, name) for name in shared}
    return run_experiment(Request(categories=names(command.category), changes=command.set, **values))
