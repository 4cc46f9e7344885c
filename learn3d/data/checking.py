"""Finds all faults of a data set at once: the report of `learn3d check-dataset`.

It calls the readers' `load` with findings that are not strict. Errors are faults that `load` would raise, warnings
those that it would accept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from learn3d.data import shards
from learn3d.data.categories import synset_of
from learn3d.data.dataset import SPLITS
from learn3d.data.layouts import LAYOUTS, Layout, layouts_in
from learn3d.data.readers import READERS
from learn3d.files.reading import Findings, Problem


@dataclass(frozen=True)
class SplitReport:
    """Faults of one category and split."""

    category: str
    split: str
    objects: int  # number of objects that the files list
    problems: tuple[Problem, ...]

    def count(self, severity: str) -> int:
        """Number of the problems that are an "error" or a "warning"."""
        return sum(problem.severity == severity for problem in self.problems)


@dataclass(frozen=True)
class Report:
    """Faults of a folder."""

    layout: str
    folder: str
    splits: tuple[SplitReport, ...]

    def count(self, severity: str) -> int:
        """Number of problems that are an "error" or a "warning"."""
        return sum(split.count(severity) for split in self.splits)

    def table(self) -> str:
        """A line per category and split: objects, errors, warnings."""
        rows = [("category", "split", "objects", "errors", "warnings")]
        rows += [(s.category, s.split, s.objects, s.count("error"), s.count("warning")) for s in self.splits]
        width = max(len(row[0]) for row in rows)
        return "\n".join(f"{row[0]:{width}}  {row[1]:5}  {row[2]:>7}  {row[3]:>6}  {row[4]:>8}" for row in rows)


def check_folder(
    layout: Layout,
    folder: Path | str,
    categories: Sequence[str] = (),
    splits: Sequence[str] = (),
    *,
    progress: bool = False,
) -> Report:
    """Examine all files of the categories and splits of a folder (default: all that it has).

    A missing category or split is an error of the report. Raises ValueError for an unknown layout, FileNotFoundError if
    the folder does not exist or has nothing of the layout.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}; got {layout!r}")
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}")
    found, others = shards.contents(folder), {}
    try:
        others = READERS[layout].contents(folder)
    except (ValueError, OSError):  # the folder has only shards, or `_check_split` finds the fault
        if not categories and not found:
            raise
    for category, there in others.items():
        found[category] = tuple(split for split in SPLITS if split in (*there, *found.get(category, ())))
    if not found and not categories:
        others = layouts_in(folder, layout)
        hint = f"it is a data set of the layout {others[0]!r}: add --layout {others[0]}" if others else "see its files"
        raise FileNotFoundError(f"{folder} holds nothing of the layout {layout!r}; {hint} (docs/data-sets.md)")
    reports = []
    for category in categories or found:
        there = found.get(category) or found.get(synset_of(category)) or SPLITS
        reports += [_check_split(layout, folder, category, split, progress) for split in splits or there]
    return Report(layout, str(folder), tuple(reports))


def _check_split(layout: str, folder: Path, category: str, split: str, progress: bool) -> SplitReport:
    load, options = READERS[layout].load, {"progress": progress} if "progress" in LAYOUTS[layout].options else {}
    if shards.holds(folder, category, split):
        load, options = shards.load, {"layout": layout}
    findings = Findings()
    try:
        load(folder, category, split, findings=findings, **options)
    except (ValueError, OSError) as error:
        path, message = getattr(error, "path", folder), getattr(error, "message", str(error))
        findings.problems.append(Problem(str(path), message))
    return SplitReport(category, split, findings.objects, tuple(dict.fromkeys(findings.problems)))
