"""Read every file of a data set and list everything that is wrong: missing, cut short, empty, inconsistent.

Examples:
  learn3d check-dataset DATA                                   (Kato's npz files)
  learn3d check-dataset DATA --layout kar --category airplane,chair --split train
  learn3d check-dataset DATA --layout r2n2 --json report.json

The exit status is 1 where training or evaluation would fail (an error), 0 where there are warnings at most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.commands.parsing import names, parse
from learn3d.data.checking import check_folder
from learn3d.data.layouts import Layout
from learn3d.files.writing import check_target, write_json
from learn3d.terminal import is_watched, say


@dataclass(frozen=True)
class Command:
    """What is asked for."""

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="DATA")]]
    """Folder of the data set."""
    layout: Layout = "kato"
    """How its files are arranged, see docs/data-sets.md."""
    category: str = ""
    """Classes to read, by name or synset id, separated by commas. None given: all that are there."""
    split: tuple[Literal["train", "val", "test"], ...] = ()
    """Splits to read. None given: all that are there."""
    json: Path | None = None
    """Also write the report to this file."""
    most: int = 100
    """Print at most so many problems; the JSON file has all."""


def run(arguments: Sequence[str]) -> int:
    """List the problems, then a table; the exit status says whether there are errors."""
    command = parse(Command, arguments, name="check-dataset", about=__doc__)
    if command.json is not None:
        check_target(command.json, "--json")
    what = (names(command.category), command.split)
    report = check_folder(command.layout, command.folder, *what, progress=is_watched())
    lines = [f"{p.severity}: {p.path}: {p.message}" for split in report.splits for p in split.problems]
    for line in lines[: command.most]:
        say(line)
    if len(lines) > command.most:
        say(f"... and {len(lines) - command.most} more (--most, --json)")
    say(f"\n{report.table()}\n\n{report.errors} errors, {report.warnings} warnings")
    if command.json is not None:
        write_json(command.json, report.to_json())
    return 1 if report.errors else 0
