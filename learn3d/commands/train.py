"""`learn3d train` and `learn3d experiment`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from learn3d.commands.command import Command
from learn3d.config import DEFAULT_PRESET, FROM_PRESET, TrainConfig, load_config
from learn3d.experiments.experiment import describe_tables, run_experiment
from learn3d.experiments.plan import Request
from learn3d.experiments.tables import TABLES
from learn3d.presets import METHODS, PRESETS, full_name
from learn3d.terminal import INTERRUPTED, say
from learn3d.training import train


@dataclass(frozen=True)
class _Origin:
    """The options that decide the other options and their defaults."""

    preset: str | None = None
    resume: bool = False
    output: Path | None = None


@dataclass(frozen=True, kw_only=True)
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
        lines = ["Methods (--preset NAME):", *(f"  {name:10}  {method.summary}" for name, method in METHODS.items())]
        if everything:
            lines += ["", "Presets (--preset NAME --help-all shows the settings of one):"]
            lines += [f"  {name:23}  {preset.label}; {preset.source}" for name, preset in PRESETS.items()]
        return "\n".join([super().about(everything), "", *lines])

    @classmethod
    def defaults(cls, arguments: Sequence[str]) -> Mapping[str, Any]:
        """The options of the saved run with --resume, else those of the preset."""
        given = [word for word in arguments if word not in ("-h", "--help", "--help-all")]
        origin, _ = tyro.cli(_Origin, args=given, return_unknown_args=True, add_help=False)
        preset = None if origin.preset is None else full_name(origin.preset)
        if not origin.resume or len(given) < len(arguments):
            chosen = PRESETS[preset or DEFAULT_PRESET]
            return {name: getattr(chosen, name) for name in FROM_PRESET if name != "warmup_steps"}
        if origin.output is None:
            raise ValueError("--resume needs --output: the folder of the run that is to go on")
        saved = load_config(origin.output / "config.json")
        if preset not in (None, saved.preset):
            raise ValueError(f"{origin.output} was started with the preset {saved.preset}, got {preset}")
        return vars(saved)

    def run(self) -> int:
        """Train and print a summary. The exit status is 130 if a signal stopped the training."""
        if self.resume and self.overwrite:
            raise ValueError("--resume continues a run and --overwrite replaces it; give one of them")
        summary = train(self.config, resume=self.resume, overwrite=self.overwrite)
        say(str(summary))
        return 0 if summary.finished else INTERRUPTED


@dataclass(frozen=True)
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
