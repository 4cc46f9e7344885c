"""Measure trained models: voxel IoU per class and its mean, and the MMD over all pairs of views.

Examples:
  python tools/evaluate.py runs/airplane runs/chair --data DATA --split test --json table.json
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from learn3d.experiments.evaluation_report import describe_columns, evaluate_runs, format_table
from learn3d.files.writing import check_target, write_json
from learn3d.terminal import in_a_sentence, note, say


@dataclass(frozen=True)
class Command:
    """Measure trained models: voxel IoU per class and its mean, and the MMD over all pairs of views."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders (or checkpoint files) to evaluate."""
    data: Path | None = None
    """Folder of the data set. None: the one each run was trained on."""
    category: str | None = None
    """Class to evaluate on. None: the one each run was trained on."""
    split: Literal["train", "val", "test"] = "test"
    """Part of the data set to evaluate on."""
    checkpoint: Literal["last", "best"] = "last"
    """Which networks of a run folder: the last ones, or those with the best validation IoU."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Arithmetic of the networks."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run."""
    json: Path | None = None
    """Also write the figures, with protocol and versions, to this file."""


@in_a_sentence()
def main() -> int:
    columns = "Columns of the table (means over the images, then over the classes; - where there is no value):"
    command = tyro.cli(Command, description=f"{__doc__}\n{columns}\n{describe_columns()}")
    if command.json is not None:
        check_target(command.json, "--json")
    report = evaluate_runs(
        command.runs,
        data=command.data,
        category=command.category,
        split=command.split,
        which=command.checkpoint,
        precision=command.precision,
        device=command.device,
        report_progress=note,
    )
    say(format_table(report))
    if command.json is not None:
        write_json(command.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
