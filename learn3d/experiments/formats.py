"""Reports as text for the terminal, and as files: JSON as they are, Markdown, one HTML page that needs nothing else."""

from __future__ import annotations

import html
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
    """Write <table>.json, .md and .html into `folder`; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{report['table']}.{suffix}" for suffix in ("json", "md", "html")]
    writing.write_json(paths[0], report)
    writing.write_bytes(paths[1], to_markdown(report).encode())
    writing.write_bytes(paths[2], to_html(report).encode())
    return paths


def to_text(report: dict[str, Any]) -> str:
    """The table for the terminal, and how long our runs were trained."""
    trained = [f"here: trained for {_trained(report)}"] if report["runs"] else []
    return "\n".join([align(main_table(report)), *_reference(report), *trained])


def to_markdown(report: dict[str, Any]) -> str:
    """Tables and text for a page. Commands have DATA and OUTPUT in place of folders, so that no path gets in."""
    parts = [f"## {report['title']}", _markdown_table(main_table(report)), *_notes(report)]
    if len(versus := baseline_table(report)) > 1:
        parts += [f"Against {report['baseline']}:", _markdown_table(versus)]
    if report["runs"]:
        parts += ["What was run:", _markdown_table(run_table(report))]
        parts += ["\n".join(["```sh", *commands(report), "```"])]
    return "\n\n".join(parts) + "\n"


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
        table.append([run["run"], network, *counts, *measures, minutes, run["commit"] or "-"])
    return table


def commands(report: dict[str, Any]) -> list[str]:
    """The commands that repeat the runs, with CATEGORY and SEED for what they differ in."""
    return list(dict.fromkeys(run["general_command"] for run in report["runs"]))


def _reference(report: dict[str, Any]) -> list[str]:
    return [REFERENCE] if any(line[1].startswith("paper") for line in main_table(report)[1:]) else []


def _notes(report: dict[str, Any]) -> list[str]:
    notes = [*_reference(report), *([report["note"]] if report["note"] else [])]
    seeds = sorted({seed for row in report["rows"] for seed in row["cells"].get(MEAN, {}).get("seeds", [])})
    if report["runs"]:
        over_seeds = f"; ±: over {len(seeds)} seeds (Student's t)" if len(seeds) > 1 else ""
        notes.append(
            "Measured on the test split. Brackets: 95 % intervals, over test objects (bootstrap; objects, not images, "
            f"are drawn again){over_seeds}."
        )
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


def _number(value: float | None, form: str = ".4f") -> str:
    return "-" if value is None else format(value, form)


def _markdown_table(table: Cells) -> str:
    header, *rows = [[_markdown_cell(cell) for cell in row] for row in table]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _markdown_cell(text: str) -> str:
    """In one line, without HTML: what stands in results may be a stranger's."""
    return html.escape(" ".join(text.splitlines()), quote=False).replace("|", "\\|")
