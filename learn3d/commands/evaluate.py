"""Measure trained models on a test set: voxel IoU of each class and its mean, and how much the codes tell of the view.

Example:
  learn3d evaluate runs/airplane runs/chair --json table.json
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.commands.parsing import parse
from learn3d.terminal import note, say


@dataclass(frozen=True)
class Command:
    """What is asked for."""

    runs: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN [RUN ...]")]]
    """Run folders, or checkpoint files."""
    data: Path | None = None
    """Folder of the data set, if not the one each run was trained on."""
    category: str | None = None
    """Classes, separated by commas, if not those each run was trained on."""
    split: Literal["train", "val", "test"] = "test"
    """Part of the data set."""
    checkpoint: Literal["last", "best"] = "last"
    """Which networks of a run: the last ones, or those with the best validation IoU."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Arithmetic of the networks."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run."""
    json: Path | None = None
    """Also write the figures, with protocol and versions, to this file."""


def run(arguments: Sequence[str]) -> int:
    """Measure, and print a table."""
    from learn3d.experiments.measurement import describe_measures, evaluate_runs, format_table, to_json
    from learn3d.files.writing import check_target, write_json

    columns = "Columns of the table (means over the images, then over the classes; - where there is no value):"
    command = parse(Command, arguments, name="evaluate", about=f"{__doc__}\n{columns}\n{describe_measures()}")
    if command.json is not None:
        check_target(command.json, "--json")
    results = evaluate_runs(
        command.runs,
        data=command.data,
        category=command.category,
        which=command.checkpoint,
        split=command.split,
        precision=command.precision,
        device=command.device,
        report_progress=note,
    )
    say(format_table(results))
    if command.json is not None:
        protocol = {"split": command.split, "checkpoint": command.checkpoint, "precision": command.precision}
        write_json(command.json, to_json(results, **protocol))
    return 0
