"""Everything that is wrong with a folder of data, found at once: what `learn3d check-dataset` prints.

A reader takes part with three functions beside `load`: `contents(folder)`, the categories and their splits;
`count(folder, category, split)`, how many objects a split should have; `problems(folder, category, split)`, what is
wrong with them. An error is what `load` would raise, a warning is what it would read in spite of being odd.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learn3d.data import shards
from learn3d.data.categories import synset_of
from learn3d.data.dataset import SPLITS
from learn3d.data.layouts import LAYOUTS, layouts_in
from learn3d.data.readers import READERS
from learn3d.files.findings import Problem


@dataclass(frozen=True)
class SplitReport:
    """One category and split."""

    category: str
    split: str
    objects: int  # how many it should have; 0 where that cannot be read
    problems: tuple[Problem, ...]

    @property
    def errors(self) -> int:
        """How many of the problems are errors."""
        return sum(problem.severity == "error" for problem in self.problems)

    @property
    def warnings(self) -> int:
        """How many of the problems are warnings."""
        return len(self.problems) - self.errors


@dataclass(frozen=True)
class Report:
    """A whole folder."""

    layout: str
    folder: str
    splits: tuple[SplitReport, ...]

    @property
    def errors(self) -> int:
        """How many problems are errors."""
        return sum(split.errors for split in self.splits)

    @property
    def warnings(self) -> int:
        """How many problems are warnings."""
        return sum(split.warnings for split in self.splits)

    def to_json(self) -> dict[str, Any]:
        """Plain values: {layout, folder, errors, warnings, splits: [{category, split, objects, problems: [..]}]}."""
        return {"errors": self.errors, "warnings": self.warnings, **dataclasses.asdict(self)}

    def table(self) -> str:
        """A line per category and split: objects, errors, warnings."""
        rows = [("category", "split", "objects", "errors", "warnings")]
        rows += [(s.category, s.split, str(s.objects), str(s.errors), str(s.warnings)) for s in self.splits]
        widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
        return "\n".join(
            "  ".join(
                cell.ljust(width) if column < 2 else cell.rjust(width)
                for column, (cell, width) in enumerate(zip(row, widths, strict=True))
            ).rstrip()
            for row in rows
        )


def check_folder(
    layout: str,
    folder: Path | str,
    categories: Sequence[str] = (),
    splits: Sequence[str] = (),
    *,
    progress: bool = False,
) -> Report:
    """Examine every file of the categories and splits of a folder; by default of all that are there.

    A category or split that was asked for and is not there is an error of the report. Raises ValueError for an unknown
    layout, FileNotFoundError for a folder that does not exist, or in which nothing of the layout is found.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}; got {layout!r}")
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}")
    found = _contents(layout, folder)
    if not found and not categories:
        others = layouts_in(folder, layout)
        what = f"; it is a data set of the layout {others[0]!r}: add --layout {others[0]}" if others else ""
        raise FileNotFoundError(f"{folder} holds nothing of the layout {layout!r}{what or '; see docs/data-sets.md'}")
    reports = []
    for category in categories or found:
        there = found.get(category) or found.get(synset_of(category)) or ("train", "val", "test")
        for split in splits or there:
            reports.append(_check_split(layout, folder, category, split, progress))
    return Report(layout, str(folder), tuple(reports))


def _contents(layout: str, folder: Path) -> dict[str, tuple[str, ...]]:
    """The categories of a folder and their splits, those in shards included."""
    found = shards.contents(folder)
    try:
        others = READERS[layout].contents(folder)
    except (ValueError, OSError):
        if not found:
            raise
        others = {}  # there are only shards
    for category, splits in others.items():
        found[category] = tuple(split for split in SPLITS if split in (*splits, *found.get(category, ())))
    return found


def _check_split(layout: str, folder: Path, category: str, split: str, progress: bool) -> SplitReport:
    stored = shards.holds(folder, category, split)
    reader = shards if stored else READERS[layout]
    options = {"layout": layout} if stored else {}
    problems = tuple(reader.problems(folder, category, split, progress=progress, **options))
    return SplitReport(category, split, _count(reader, folder, category, split), problems)


def _count(reader: Any, folder: Path, category: str, split: str) -> int:
    try:
        return reader.count(folder, category, split)
    except (ValueError, FileNotFoundError):
        return 0  # the problems say why
