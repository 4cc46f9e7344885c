"""`learn3d report`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from learn3d.commands.command import OnDataset, Runs
from learn3d.terminal import note, say


@dataclass(frozen=True, kw_only=True)
class Report(OnDataset):
    """Write one HTML file about trained runs: options, curves, test IoU, and shapes that can be turned by hand.

    Examples:
      learn3d report runs/plus runs/vanilla --output report.html
      learn3d report runs/plus --data DATA --indices 0 31 62 --output report.html
    """

    runs: Runs
    """Run folders, or checkpoint files, of one category."""
    output: Path
    """File to write, .html."""
    labels: tuple[str, ...] = ()
    """Names of the runs (default: those of their presets)."""
    objects: int = 12
    """Number of objects whose shapes are shown, spread from the best IoU to the worst."""
    indices: tuple[int, ...] = ()
    """Numbers of the images to show (default: as --objects says). With V views of each object, image n * V + k is view
    k of object n."""

    def run(self) -> None:
        if not self.runs:
            raise ValueError("give at least one run folder or checkpoint to report on")
        from learn3d.files.writing import check_target
        from learn3d.pages.report import write_report

        check_target(self.output, "--output")
        shown = {"labels": self.labels, "objects": self.objects, "indices": self.indices}
        size = write_report(self.runs, self.output, report_progress=note, **shown, **self.where)
        say(f"{self.output} ({size / 1e6:.1f} MB)")
