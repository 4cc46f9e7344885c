"""Reports of tables as text for the terminal, and as files: JSON as they are, and Markdown."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

from learn3d.experiments.report import MEAN
from learn3d.files import writing
from learn3d.terminal import align

Cells = list[list[str]]
REFERENCE = "paper: on its own data, with its own length of training; for reference, not for comparison."


def write_report(folder: Path, report: dict[str, Any]) -> list[Path]:
    """Write <table>.json and <table>.md into `folder`; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{report['table']}.{suffix}" for suffix in ("json", "md")]
    writing.write_json(paths[0], report)
    writing.write_bytes(paths[1], to_markdown(report).encode())
    return paths


def to_text(report: dict[str, Any]) -> str:
    """The table for the terminal, and the length of our training."""
    trained = [f"here: trained for {_lengths(report)}"] if report["runs"] else []
    return "\n".join([align(main_table(report)), *_reference(report), *trained])


def to_markdown(report: dict[str, Any]) -> str:
    """Tables and notes for a page. Commands have DATA and OUTPUT in place of folders, so that no path gets in."""
    parts = [f"## {report['title']}", _markdown_table(main_table(report)), *_notes(report)]
    if len(differences := baseline_table(report)) > 1:
        parts += [f"Against {report['baseline']}:", _markdown_table(differences)]
    if report["runs"]:
        commands = dict.fromkeys(run["general_command"] for run in report["runs"])
        parts += ["What was run:", _markdown_table(run_table(report)), "\n".join(["```sh", *commands, "```"])]
    return "\n\n".join(parts) + "\n"


def main_table(report: dict[str, Any]) -> Cells:
    """The header; then for each method a line with the paper's figures, for reference, and lines with ours."""
    columns = [*report["categories"], MEAN]
    table = [["method", "", *columns]]
    for row in report["rows"]:
        cells, lines = [row["cells"][column] for column in columns], []
        if any("paper" in cell or "paper_printed" in cell for cell in cells):
            quoted = f", quoted from {row['quoted_from']}" if row["quoted_from"] else ""
            voxeliser = "voxeliser not stated" if row["metric"] == "unknown" else row["metric"]
            lines.append([f"paper{quoted} ({voxeliser})", *map(_paper_text, cells)])
        if row["variant"] is not None:
            metrics = ["mmd"] if report["metric"] == "mmd" else ["kato18", "kato19"]
            lines += [[f"here ({metric})", *(_our_text(cell, metric) for cell in cells)] for metric in metrics]
        table += [[row["label"] if number == 0 else "", *line] for number, line in enumerate(lines)]
    return table


def baseline_table(report: dict[str, Any]) -> Cells:
    """For each method its difference to the baseline; for the MMD also the ratio."""
    columns = [*report["categories"], MEAN]
    table = [["method", "", *columns]]
    for row in report["rows"]:
        differences = [row["cells"][column].get("to_baseline") for column in columns]
        if any(differences):
            table.append([row["label"], "difference", *map(_difference_text, differences)])
    return table


def run_table(report: dict[str, Any]) -> Cells:
    """A line per run: its training and all its measures."""
    header = ["run", "networks", "iterations", "batch", "objects", "images", "kato18", "kato19", "MMD", "printed MMD"]
    table = [[*header, "Chamfer-L1", "F-score", "minutes", "commit"]]
    for run in report["runs"]:
        networks = run["checkpoint"] + (f" (step {run['step']})" if run["step"] != run["iterations"] else "")
        counts = [str(run[key]) for key in ("iterations", "batch_size", "objects", "images")]
        measures = [_number(run[key]) for key in ("kato18", "kato19", "mmd", "mmd_paper", "chamfer_l1", "f_score")]
        minutes = _number(run["seconds"] and run["seconds"] / 60, ".1f")
        table.append([run["run"], networks, *counts, *measures, minutes, run["commit"] or "-"])
    return table


def _reference(report: dict[str, Any]) -> list[str]:
    return [REFERENCE] if any(line[1].startswith("paper") for line in main_table(report)[1:]) else []


def _notes(report: dict[str, Any]) -> list[str]:
    rows, notes = report["rows"], [*_reference(report), *([report["note"]] if report["note"] else [])]
    seeds = {seed for row in rows for seed in row["cells"].get(MEAN, {}).get("seeds", [])}
    if report["runs"]:
        over_seeds = f"; ±: over {len(seeds)} seeds (Student's t)" if len(seeds) > 1 else ""
        notes.append(
            "Measured on the test split. Brackets: 95 % intervals, over test objects (bootstrap; objects, not images, "
            f"are drawn again){over_seeds}."
        )
    for note in dict.fromkeys(row["published_note"] for row in rows if row["published_note"]):
        labels = ", ".join(row["label"] for row in rows if row["published_note"] == note)
        notes.append(f"{labels}, paper's figures: {note}.")
    if any(_has_printed_mean_alone(row["cells"][MEAN]) for row in rows):
        notes.append("A mean in parentheses is the paper's over its own categories, which are not the ones here.")
    if "," in _lengths(report):
        notes.append(f"The runs were not all trained alike: {_lengths(report)}.")
    if report["missing"]:
        notes.append(f"Missing: {', '.join(report['missing'])}.")
    return notes


def _lengths(report: dict[str, Any]) -> str:
    """The different lengths of training of the runs."""
    lengths = sorted({(run["iterations"], run["batch_size"]) for run in report["runs"]})
    return ", ".join(f"{iterations} iterations of batch {batch}" for iterations, batch in lengths)


def _has_printed_mean_alone(cell: dict[str, Any]) -> bool:
    return "paper_printed" in cell and "paper" not in cell


def _paper_text(cell: dict[str, Any]) -> str:
    return f"({cell['paper_printed']:.3f})" if _has_printed_mean_alone(cell) else _number(cell.get("paper"), ".3f")


def _our_text(cell: dict[str, Any], metric: str) -> str:
    """The value, half the width of the interval over seeds, and the interval over objects."""
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


def _intervals(seeds: list[float] | None, objects: list[float] | None, form: str) -> str:
    text = "" if seeds is None else f" ±{(seeds[1] - seeds[0]) / 2:.3f}"
    return text + ("" if objects is None else f" [{_number(objects[0], form)}, {_number(objects[1], form)}]")


def _number(value: float | None, form: str = ".4f") -> str:
    return "-" if value is None else format(value, form)


def _markdown_table(table: Cells) -> str:
    """The table without HTML: names in results may be a stranger's."""
    cells = [[html.escape(" ".join(c.splitlines()), quote=False).replace("|", "\\|") for c in row] for row in table]
    lines = ["| " + " | ".join(row) + " |" for row in cells]
    return "\n".join([lines[0], "|" + "---|" * len(cells[0]), *lines[1:]])
