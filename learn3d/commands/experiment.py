"""`learn3d experiment`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from learn3d.commands.command import Command
from learn3d.experiments.experiment import describe_tables, run_experiment
from learn3d.experiments.plan import Request
from learn3d.experiments.tables import TABLES
from learn3d.terminal import say


@dataclass(frozen=True)
class Experiment(Request, Command):
    """Make a table of the paper: train what it needs, measure it, and put the paper's figures beside ours.

    Examples:
      learn3d experiment --list
      learn3d experiment kato --data DATA --output OUTPUT --category airplane,chair --iterations 5000 --jobs 2
      learn3d experiment ablation --data DATA --output OUTPUT --category chair --set precision=fp32
      learn3d experiment mmd --data DATA --output OUTPUT --category airplane,chair --iterations 5000 --report-only

    Tables share their runs: complete runs are skipped, interrupted ones go on, also those that `learn3d train` made in
    OUTPUT/runs/<category>/<method>-seed<k>. Ctrl-C stops all of them; the same command continues.
    """

    table: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="TABLE")]]
    list: bool = False
    """Show the tables and their methods, and end."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Mapping[str, Any]:
        return {"table": next(iter(TABLES)), "data": Path(), "output": Path()} if "--list" in arguments else {}

    def run(self) -> int:
        if self.list:
            say(describe_tables())
            return 0
        return run_experiment(self)
