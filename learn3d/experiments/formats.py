"""Reports as files: JSON as they are, CSV with a line per run, Markdown, and one HTML page that needs nothing else."""

from __future__ import annotations

import csv
import html
import io
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from learn3d.experiments.report import MEAN
from learn3d.files import writing
from learn3d.terminal import align

Cells = list[list[str]]
REFERENCE = "paper: on its own data, with its own length of training; for reference, not for comparison."


def write_report(folder: Path, report: dict[str, Any]) -> list[Path]:
    """Write <table>.json, .csv, .md and .html into `folder`; returns their paths."""
    name = report["table"]
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.{suffix}" for suffix in ("json", "csv", "md", "html")]
    writing.write_json(paths[0], report)
    for path, text in zip(paths[1:], (to_csv(report), to_markdown(report), to_html(report)), strict=True):
        writing.write_bytes(path, text.encode())
    return paths


def embed(page: Path, report: dict[str, Any]) -> None:
    """Put the Markdown report into `page`, in place of what is between <!-- table: NAME --> and <!-- end: NAME -->.

    Raises ValueError where the page does not have the two lines.
    """
    before, after = _around(page, report["table"])
    writing.write_bytes(page, f"{before}\n{to_markdown(report, heading=False)}{after}".encode())


def check_page(page: Path, table: str) -> None:
    """Raise what `embed` would, for the beginning of long work: ValueError, or OSError for a page that is not there or
    cannot be replaced."""
    writing.check_target(page, "--page")
    _around(page, table)


def _around(page: Path, table: str) -> tuple[str, str]:
    """What a page has before and after a table's place, the marks included."""
    text = page.read_text()
    start, end = f"<!-- table: {table} -->", f"<!-- end: {table} -->"
    if text.count(start) != 1 or text.count(end) != 1 or text.index(end) < text.index(start):
        raise ValueError(f"{page} must have the lines {start!r} and {end!r}, once each, where the table belongs")
    return text[: text.index(start)] + start, text[text.index(end) :]


def to_csv(report: dict[str, Any]) -> str:
    """One line per run."""
    out = io.StringIO()
    names = [name for name in report["runs"][0] if name != "general_command"] if report["runs"] else ["run"]
    writer = csv.DictWriter(out, names, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(report["runs"])
    return out.getvalue()


def to_markdown(report: dict[str, Any], *, heading: bool = True) -> str:
    """Tables and text for a page. Commands have DATA and OUTPUT in place of folders, so that no path gets in."""
    parts = [f"## {report['title']}"] if heading else []
    parts += [_markdown_table(main_table(report))]
    parts += _notes(report)
    if len(versus := baseline_table(report)) > 1:
        parts += [f"Against {report['baseline']}:", _markdown_table(versus)]
    if report["runs"]:
        parts += [
            "What was run:",
            _markdown_table(run_table(report)),
            _code(commands(report)),
        ]
    return "\n\n".join(parts) + "\n"


def _code(lines: list[str]) -> str:
    """A block of commands with a fence that is in none of them."""
    longest = max((len(run) for line in lines for run in re.findall("`+", line)), default=0)
    fence = "`" * max(3, longest + 1)
    return "\n".join([f"{fence}sh", *lines, fence])


def to_text(report: dict[str, Any]) -> str:
    """The table for the terminal, and how long our runs were trained."""
    trained = f"\nhere: trained for {_trained(report)}" if report["runs"] else ""
    return f"{align(main_table(report))}\n{REFERENCE}{trained}"


def to_html(report: dict[str, Any]) -> str:
    """A page of its own, with the style in it."""
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string(resources.files("learn3d.experiments").joinpath("report.html").read_text("utf-8"))
    tables = {"main": main_table(report), "versus": baseline_table(report), "runs": run_table(report)}
    return page.render(report=report, notes=_notes(report), commands=commands(report), **tables)


def main_table(report: dict[str, Any]) -> Cells:
    """Per method a line with the paper's figures, for reference, and one with ours; first the header."""
    columns = [*report["categories"], MEAN]
    table = [["method", "", *columns]]
    for row in report["rows"]:
        cells = [row["cells"][column] for column in columns]
        quoted = f", quoted from {row['quoted_from']}" if row["quoted_from"] else ""
        label = row["label"]
        if any("paper" in cell or "paper_printed" in cell for cell in cells):
            voxeliser = "voxeliser not stated" if row["metric"] == "unknown" else row["metric"]
            table.append([label, f"paper{quoted} ({voxeliser})", *map(_paper_text, cells)])
            label = ""
        if any("code" in cell for cell in cells):
            texts = (_number(cell.get("code"), ".3f") for cell in cells)
            table.append([label, "published code, same meshes", *texts])
            label = ""
        if row["variant"] is not None:
            metrics = [row["metric"]] if report["metric"] == "mmd" else ["kato18", "kato19"]
            for metric in metrics:
                table.append([label, f"here ({metric})", *(_ours_text(cell, metric) for cell in cells)])
                label = ""
    return table


def baseline_table(report: dict[str, Any]) -> Cells:
    """Per method its difference to the baseline with the interval over objects, or for the MMD the ratio."""
    columns = [*report["categories"], MEAN]
    table = [["method", "", *columns]]
    for row in report["rows"]:
        differences = [row["cells"][column].get("to_baseline") for column in columns]
        if any(differences):
            table.append([row["label"], "difference", *map(_difference_text, differences)])
    return table


def run_table(report: dict[str, Any]) -> Cells:
    """A line per run: what was trained, on how much, and everything that was measured."""
    header = ["run", "networks", "iterations", "batch", "objects", "images", "kato18", "kato19", "MMD", "printed MMD"]
    table = [[*header, "Chamfer-L1", "F-score", "minutes", "commit"]]
    for run in report["runs"]:
        network = run["checkpoint"] + (f" (step {run['step']})" if run["step"] != run["iterations"] else "")
        counts = [str(run[key]) for key in ("iterations", "batch_size", "objects", "images")]
        measures = [_number(run[key]) for key in ("kato18", "kato19", "mmd", "mmd_paper", "chamfer_l1", "f_score")]
        minutes = "-" if run["seconds"] is None else f"{run['seconds'] / 60:.1f}"
        table.append([run["run"], network, *counts, *measures, minutes, _commit_text(run)])
    return table


def commands(report: dict[str, Any]) -> list[str]:
    """The commands that repeat the runs, with CATEGORY and SEED for what they differ in."""
    return list(dict.fromkeys(run["general_command"] for run in report["runs"]))


def _notes(report: dict[str, Any]) -> list[str]:
    notes = [REFERENCE, *([report["note"]] if report["note"] else [])]
    seeds = sorted({seed for row in report["rows"] for seed in row["cells"].get(MEAN, {}).get("seeds", [])})
    about = "Brackets: 95 % intervals, over test objects (bootstrap; objects, not images, are drawn again)"
    if len(seeds) > 1:
        about += f"; ±: over {len(seeds)} seeds (Student's t)"
    about = f"Measured on the test split. {about}." if report["runs"] else ""
    notes += [about] if about else []
    for note in dict.fromkeys(row["published_note"] for row in report["rows"] if row["published_note"]):
        labels = ", ".join(row["label"] for row in report["rows"] if row["published_note"] == note)
        notes.append(f"{labels}, paper's figures: {note}.")
    if any(_only_printed(row["cells"][MEAN]) for row in report["rows"]):
        notes.append("A mean in parentheses is the paper's over its own categories, which are not the ones here.")
    if len(_lengths(report)) > 1:
        notes.append(f"The runs were not all trained alike: {_trained(report)}.")
    if report["missing"]:
        notes.append(f"Not there yet: {', '.join(report['missing'])}.")
    return notes


def _lengths(report: dict[str, Any]) -> list[tuple[int, int]]:
    """The different (iterations, batch size) of the runs."""
    return sorted({(run["iterations"], run["batch_size"]) for run in report["runs"]})


def _trained(report: dict[str, Any]) -> str:
    return ", ".join(f"{iterations} iterations of batch {batch}" for iterations, batch in _lengths(report))


def _only_printed(cell: dict[str, Any]) -> bool:
    return "paper_printed" in cell and "paper" not in cell


def _paper_text(cell: dict[str, Any]) -> str:
    return f"({cell['paper_printed']:.3f})" if _only_printed(cell) else _number(cell.get("paper"), ".3f")


def _ours_text(cell: dict[str, Any], metric: str) -> str:
    """Value, half width of the interval over seeds, interval over objects."""
    if metric not in cell.get("values", {}):
        return "-"
    intervals = (cell["interval_seeds"].get(metric), cell["interval_objects"].get(metric))
    return _number(cell["values"][metric], ".3f") + _intervals(*intervals, ".3f")


def _difference_text(difference: dict[str, Any] | None) -> str:
    if difference is None:
        return "-"
    ratio = f" (x {difference['ratio']:.2f})" if "ratio" in difference else ""
    intervals = (difference.get("interval_seeds"), difference.get("interval_objects"))
    return _number(difference["value"], "+.3f") + _intervals(*intervals, "+.3f") + ratio


def _intervals(seeds: Sequence[float] | None, objects: Sequence[float] | None, form: str) -> str:
    text = "" if seeds is None else f" ±{(seeds[1] - seeds[0]) / 2:.3f}"
    return text + ("" if objects is None else f" [{_number(objects[0], form)}, {_number(objects[1], form)}]")


def _commit_text(run: dict[str, Any]) -> str:
    """The commit that trained a run, or where that was not recorded the one that tested it."""
    if run["commit"]:
        return run["commit"][:9] + ("-dirty" if run["commit"].endswith("-dirty") else "")
    return f"tested at {run['tested_at'][:9]}" if run["tested_at"] else "-"


def _number(value: float | None, form: str = ".4f") -> str:
    return "-" if value is None else format(value, form)


def _markdown_table(table: Cells) -> str:
    header, *rows = [[_markdown_cell(cell) for cell in row] for row in table]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _markdown_cell(text: str) -> str:
    """In one line, without HTML: names in results may be a stranger's."""
    return html.escape(" ".join(text.splitlines()), quote=False).replace("|", "\\|")
