"""Write one HTML file about trained runs: options, curves, test IoU, and shapes that can be turned by hand.

Examples:
  learn3d report runs/plus runs/vanilla --output report.html
  learn3d report runs/plus --data DATA --indices 0 31 62 --output report.html
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
    """Run folders, or checkpoint files, of one class."""
    output: Path
    """File to write, .html."""
    labels: tuple[str, ...] = ()
    """What to call each run, if not by its preset."""
    data: Path | None = None
    """Folder of the data set, if not the one the runs were trained on."""
    category: str | None = None
    """Class to measure on, if not the one the runs were trained on."""
    split: Literal["train", "val", "test"] = "test"
    """Part of the data set."""
    checkpoint: Literal["last", "best"] = "last"
    """Which networks of a run: the last ones, or those with the best validation IoU."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the networks run."""
    objects: int = 12
    """How many objects to show shapes of, spread from the best IoU to the worst."""
    indices: tuple[int, ...] = ()
    """Numbers of the images to show, in place of --objects. With V views of each object, image n * V + k is view k of
    object n."""


def run(arguments: Sequence[str]) -> int:
    """Measure, write the page, and say how large it is."""
    command = parse(Command, arguments, name="report", about=__doc__)
    if not command.runs:
        raise ValueError("give at least one run folder or checkpoint to report on")
    from learn3d.files.writing import check_target
    from learn3d.pages.report import write_report

    check_target(command.output, "--output")
    size = write_report(
        command.runs,
        command.output,
        labels=command.labels,
        data=command.data,
        category=command.category,
        split=command.split,
        which=command.checkpoint,
        device=command.device,
        objects=command.objects,
        indices=command.indices,
        report_progress=note,
    )
    say(f"{command.output} ({size / 1e6:.1f} MB)")
    return 0
