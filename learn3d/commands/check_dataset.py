"""`learn3d check-dataset`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from learn3d.commands.command import Command, Split
from learn3d.data.checking import check_folder
from learn3d.data.layouts import Layout
from learn3d.files.writing import check_target, write_json
from learn3d.settings import split_names
from learn3d.terminal import is_watched, say


@dataclass(frozen=True)
class CheckDataset(Command):
    """Read every file of a data set and list everything that is wrong: missing, cut short, empty, inconsistent.

    Examples:
      learn3d check-dataset DATA                                   (Kato's npz files)
      learn3d check-dataset DATA --layout kar --category airplane,chair --split train
      learn3d check-dataset DATA --layout r2n2 --json report.json

    The exit status is 1 if training or evaluation would fail (an error), 0 if there are warnings at most.
    """

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DATA")]]
    """Folder of the data set."""
    layout: Layout = "kato"
    """Arrangement of its files, see docs/data-sets.md."""
    category: str = ""
    """Categories to read, by name or synset id, separated by commas (default: all that are there)."""
    split: tuple[Split, ...] = ()
    """Splits to read (default: all that are there)."""
    json: Path | None = None
    """Write the report to this file, too (default: to none)."""
    most: int = 100
    """Number of problems to print; the JSON file has all of them."""

    def run(self) -> int:
        if self.json is not None:
            check_target(self.json, "--json")
        report = check_folder(self.layout, self.folder, split_names(self.category), self.split, progress=is_watched())
        lines = [f"{p.severity}: {p.path}: {p.message}" for split in report.splits for p in split.problems]
        for line in lines[: self.most]:
            say(line)
        if len(lines) > self.most:
            say(f"... and {len(lines) - self.most} more (--most, --json)")
        say(f"\n{report.table()}\n\n{report.errors} errors, {report.warnings} warnings")
        if self.json is not None:
            write_json(self.json, report.to_json())
        return 1 if report.errors else 0
