"""`learn3d evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from learn3d.commands.command import OnDataset, Runs
from learn3d.terminal import note, say


@dataclass(frozen=True, kw_only=True)
class Evaluate(OnDataset):
    """Measure trained models on a test set: voxel IoU of each category and its mean, and more.

    Example:
      learn3d evaluate runs/airplane runs/chair --json table.json
    """

    runs: Runs
    """Run folders, or checkpoint files."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Arithmetic of the networks."""
    json: Path | None = None
    """Write the figures, with protocol and versions, to this file, too (default: to none)."""

    @classmethod
    def about(cls, everything: bool) -> str:
        from learn3d.experiments.measurement import describe_measures

        columns = "Columns of the table (means over the images, then over the categories; - if there is no value):"
        return f"{super().about(everything)}\n\n{columns}\n{describe_measures()}"

    def run(self) -> None:
        from learn3d.experiments.measurement import evaluate_runs, format_table, to_json
        from learn3d.files.writing import check_target, write_json

        if self.json is not None:
            check_target(self.json, "--json")
        results = evaluate_runs(self.runs, precision=self.precision, report_progress=note, **self.where)
        say(format_table(results))
        if self.json is not None:
            protocol = {"split": self.split, "checkpoint": self.which, "precision": self.precision}
            write_json(self.json, to_json(results, **protocol))
