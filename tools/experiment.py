"""Make a table of the paper: train what it needs, measure it, and put the paper's figures beside ours.

Examples:
  python tools/experiment.py --list
  python tools/experiment.py kato --data DATA --output OUTPUT --categories airplane chair --iterations 5000 --jobs 2
  python tools/experiment.py ablation --data DATA --output OUTPUT --categories chair --set precision=fp32
  python tools/experiment.py mmd --data DATA --output OUTPUT --report-only --page docs/results.md

Runs are shared between tables and found again: what is complete is skipped, what was stopped goes on, also runs that
tools/train.py made in OUTPUT/runs/<category>/<method>-seed<k>. Ctrl-C stops all of them; the same command continues.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.data.layouts import Layout
from learn3d.experiments.experiment import Call, describe_tables, run_experiment
from learn3d.experiments.plan import Options
from learn3d.terminal import in_a_sentence


@dataclass(frozen=True)
class Command:
    """Make a table of the paper: train what it needs, measure it, and put the paper's figures beside ours."""

    table: tyro.conf.Positional[str]
    """Name of the table, see --list."""
    data: Path
    """Folder of the data set."""
    output: Path
    """Folder of runs and reports; all tables can share one."""
    categories: tuple[str, ...] = ()
    """Categories to train on, each by itself. None given: the table's."""
    methods: tuple[str, ...] = ()
    """Methods (rows) of the table. None given: all."""
    iterations: int | None = None
    """Training steps of every run. None: the published number."""
    batch_size: int | None = None
    """Images per step. None: the published number."""
    seeds: int | None = None
    """Number of seeds, 0 .. seeds - 1. None: the table's."""
    jobs: int = 1
    """Runs at a time, each in a process of its own with its share of the cores."""
    threads: int | None = None
    """CPU threads of each run. None: cores / jobs."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run."""
    layout: Layout | None = None
    """Layout of the data set. None: the table's."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[METHOD:]NAME=VALUE")] = ()
    """Settings and training options to change, in all methods that have them or in one."""
    overwrite: bool = False
    """Start runs anew that are there with other options."""
    report_only: bool = False
    """Train nothing: report what is there."""
    beside_code: bool = False
    """Put the published code's figures on the meshes of docs/results.md beside ours, for the same iterations."""
    page: Path | None = None
    """Also put the table into this Markdown page, between its marks."""


@in_a_sentence()
def main() -> int:
    if "--list" in sys.argv[1:]:
        print(describe_tables())
        return 0
    command = tyro.cli(Command, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,))
    shared = ("data", "output", "categories", "methods", "iterations", "batch_size", "seeds", "layout", "device")
    options = Options(**{name: getattr(command, name) for name in shared}, threads=command.threads, changes=command.set)
    named = ("table", "jobs", "overwrite", "report_only", "page", "beside_code")
    call = Call(options=options, **{name: getattr(command, name) for name in named})
    return run_experiment(call)


if __name__ == "__main__":
    sys.exit(main())
