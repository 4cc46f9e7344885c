"""`learn3d train` and `learn3d experiment`."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from learn3d.commands.command import Command
from learn3d.config import DEFAULT_PRESET, FROM_PRESET, TrainConfig, load_config
from learn3d.experiments.experiment import describe_tables, run_experiment
from learn3d.experiments.plan import Request
from learn3d.experiments.tables import TABLES
from learn3d.presets import PRESETS, SHORT_NAMES, full_name
from learn3d.terminal import INTERRUPTED, say
from learn3d.training import train


class Train(Command):
    """Train a model that turns one image into a 3D shape.

    Examples:
      learn3d train --data DATA --category airplane,car --output runs/airplane --preset vanilla
      learn3d train --resume --output runs/airplane
    """

    config: TrainConfig
    resume: bool = False
    """Continue the run in --output; its saved options apply unless given again."""
    overwrite: bool = False
    """Replace an earlier run in --output."""

    @classmethod
    def about(cls, everything: bool) -> str:
        lines = ["Methods (--preset NAME):", *(f"  {name:10}  {summary}" for name, (_, summary) in SHORT_NAMES.items())]
        if everything:
            lines += ["", "Presets (--preset NAME --help-all shows the settings of one):"]
            lines += [f"  {name:23}  {preset.label}; {preset.source}" for name, preset in PRESETS.items()]
        return "\n".join([super().about(everything), "", *lines])

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Mapping[str, Any]:
        """The options of the saved run with --resume, else those of the preset."""
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        parser.add_argument("--preset", nargs="?")
        parser.add_argument("--output", nargs="?", type=Path)
        parser.add_argument("--resume", action="store_true")
        given, others = parser.parse_known_args(arguments)
        preset = full_name(given.preset) if given.preset else None
        if not given.resume or {"-h", "--help", "--help-all"} & set(others):
            chosen = PRESETS[preset or DEFAULT_PRESET]
            return {name: getattr(chosen, name) for name in FROM_PRESET if name != "warmup_steps"}
        if given.output is None:
            raise ValueError("--resume needs --output: the folder of the run that is to go on")
        saved = load_config(given.output / "config.json")
        if preset not in (None, saved.preset):
            raise ValueError(f"{given.output} was started with the preset {saved.preset}, got {preset}")
        return vars(saved)

    def run(self) -> int:
        """Train and print a summary. The exit status is 130 if a signal stopped the training."""
        if self.resume and self.overwrite:
            raise ValueError("--resume continues a run and --overwrite replaces it; give one of them")
        summary = train(self.config, resume=self.resume, overwrite=self.overwrite)
        say(str(summary))
        return 0 if summary.finished else INTERRUPTED


class Experiment(Request, Command):
    """Make a table of the paper: train its runs, measure them, and report the paper's values beside ours.

    Examples:
      learn3d experiment --list
      learn3d experiment kato --data DATA --output OUTPUT --category airplane,chair --iterations 5000 --jobs 2
      learn3d experiment ablation --data DATA --output OUTPUT --category chair --set precision=fp32
      learn3d experiment mmd --data DATA --output OUTPUT --category airplane,chair --iterations 5000 --report-only

    Tables share their runs in OUTPUT/runs/<category>/<method>-seed<k>, with those that `learn3d train` made there:
    complete runs are skipped, interrupted ones continue. Ctrl-C stops all of them; the same command continues.
    """

    table: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="TABLE")]]
    list: bool = False
    """Show the tables and their methods, and exit."""

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Mapping[str, Any]:
        return {"table": next(iter(TABLES)), "data": Path(), "output": Path()} if "--list" in arguments else {}

    def run(self) -> int:
        if self.list:
            say(describe_tables())
            return 0
        return run_experiment(self)
