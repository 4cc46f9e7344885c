"""Commands on runs: train a model, and measure trained ones."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from learn3d.commands.command import Command, OnDataset, Runs
from learn3d.config import DEFAULT_PRESET, FROM_PRESET, TrainConfig, load_config
from learn3d.files.writing import check_target, write_json
from learn3d.presets import PRESETS, SHORT_NAMES, full_name
from learn3d.runs.distributed import join_ranks, rank
from learn3d.runs.measurement import MEASURES, class_means, evaluate_runs, format_table
from learn3d.terminal import INTERRUPTED, align, say
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
        with join_ranks(self.config.device):
            summary = train(self.config, resume=self.resume, overwrite=self.overwrite)
            if rank() == 0:
                say(str(summary))
        return 0 if summary.finished else INTERRUPTED


class Evaluate(OnDataset):
    """Measure trained models on a test set: voxel IoU of each category and its mean, and more.

    Example:
      learn3d evaluate runs/airplane runs/chair --json table.json
    """

    runs: Runs
    """Run folders, or checkpoint files."""
    layout: str | None = None
    """Arrangement of the files of the data set (default: from the run)."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device on which the networks run."""
    json: Path | None = None
    """JSON file for the results, with protocol and versions (default: none)."""

    @classmethod
    def about(cls, everything: bool) -> str:
        columns = "Columns of the table (means over the images, then over the categories; - if there is no value):"
        measures = align([("", *measure) for measure in MEASURES.values()])
        return f"{super().about(everything)}\n\n{columns}\n{measures}"

    def run(self) -> None:
        if self.json is not None:
            check_target(self.json, "--json")
        results = evaluate_runs(self.runs, **self.pick("layout", "device"))
        say(format_table(results))
        if self.json is not None:
            protocol = {"split": self.split, "checkpoint": self.which}
            values = [result.model_dump() for result in results]
            write_json(self.json, {"protocol": protocol, "results": values, "means": class_means(results)})
