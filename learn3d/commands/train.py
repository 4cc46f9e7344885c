"""Commands on runs: train a model, and measure trained ones."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from learn3d.commands.command import HELP, Command, OnDataset, Runs
from learn3d.config import TrainConfig
from learn3d.distributed import join_ranks, rank
from learn3d.files.writing import check_target, write_json
from learn3d.presets import DEFAULT_PRESET, PRESETS, SHORT_NAMES, full_name, load_config
from learn3d.runs.baselines import baselines_of_runs
from learn3d.runs.measurement import (
    MEASURES,
    Baseline,
    Result,
    class_means,
    evaluate_runs,
    format_table,
)
from learn3d.terminal import INTERRUPTED, align, say
from learn3d.training import train


@dataclass(frozen=True)
class _Chosen:
    """The options of `Train` that decide the defaults of the others."""

    preset: str | None = None
    output: Path | None = None
    resume: bool = False


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
    def about(cls) -> str:
        lines = [
            "Methods (--preset NAME):",
            *(f"  {name:10}  {summary}" for name, (_, summary) in SHORT_NAMES.items()),
        ]
        lines += ["", "Presets (--preset NAME --help shows the settings of one):"]
        lines += [f"  {name:23}  {preset.label}" for name, preset in PRESETS.items()]
        return "\n".join([super().about(), "", *lines])

    @classmethod
    def default(cls, arguments: Sequence[str]) -> "Train":
        """The options of the saved run with --resume, else those of the preset."""
        words = [word for word in arguments if word not in HELP]
        given, _ = tyro.cli(_Chosen, prog="learn3d train", args=words, return_unknown_args=True)
        preset = full_name(given.preset or DEFAULT_PRESET)
        if not given.resume or len(words) < len(arguments):
            return cls(config=PRESETS[preset])
        if given.output is None:
            raise ValueError("--resume needs --output: the folder of the run that is to go on")
        saved = load_config(given.output / "config.json")
        if given.preset and preset != saved.preset:
            raise ValueError(
                f"{given.output} was started with the preset {saved.preset}, got {preset}"
            )
        return cls(config=saved)

    @classmethod
    def parse(cls, name: str, arguments: Sequence[str]) -> "Train":
        command = super().parse(name, arguments)
        preset = full_name(command.config.preset)  # it may be the short name of a method
        return dataclasses.replace(
            command, config=dataclasses.replace(command.config, preset=preset)
        )

    def run(self) -> int:
        """Train and print a summary. The exit status is 130 if a signal stopped the training."""
        if self.resume and self.overwrite:
            raise ValueError(
                "--resume continues a run and --overwrite replaces it; give one of them"
            )
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
    """Arrangement of the files of the data set. If not given: from the run."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device on which the networks run."""
    baselines: bool = False
    """Also measure the mean shape and the nearest of the training objects, as the answer to every
    image."""
    json: Path | None = None
    """JSON file for the results, with protocol and versions."""

    @classmethod
    def about(cls) -> str:
        columns = (
            "Columns of the table (means over the images; the last row of a method is the mean over seeds, then over\n"
            "categories, and is left out if two of its runs have the same category and seed; - if there is no value):"
        )
        measures = align([("", *measure) for measure in MEASURES.values()])
        return f"{super().about()}\n\n{columns}\n{measures}"

    def run(self) -> None:
        if self.json is not None:
            check_target(self.json, "--json")
        baselines = baselines_of_runs(self.runs, **self.pick("layout")) if self.baselines else []
        results: list[Result] = []
        try:
            for result in evaluate_runs(self.runs, **self.pick("layout", "device")):
                results.append(result)
        finally:  # what is measured is not lost if a later category cannot be read
            if results:
                self._report(results, baselines)

    def _report(self, results: Sequence[Result], baselines: Sequence[Baseline]) -> None:
        say(format_table(results, baselines))
        if self.json is not None:
            protocol = {"split": self.split, "checkpoint": self.which}
            values = [result.model_dump() for result in results]
            content = {"protocol": protocol, "results": values, "means": class_means(results)}
            if self.baselines:
                content["baselines"] = [baseline.model_dump() for baseline in baselines]
            write_json(self.json, content)
