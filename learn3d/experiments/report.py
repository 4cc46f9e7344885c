"""A table from stored results: the paper's figures beside ours, confidence intervals; plain values.

The paper's figures are of other meshes, so no difference to them is taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from learn3d.experiments.evaluation_report import MEANINGS
from learn3d.experiments.plan import Options, Run, command_line, selected_rows
from learn3d.experiments.published import CATEGORIES, PublishedRow
from learn3d.experiments.results import object_sums
from learn3d.experiments.statistics import LEVEL, RESAMPLES, percentile_interval, resampled_means, t_interval
from learn3d.experiments.tables import Row, Table

MEAN = "mean"  # the column after the categories
MEASURES = {
    "kato18": "voxel_iou_kato18",
    "kato19": "voxel_iou_kato19",
    "mmd": "mmd",
    "mmd_paper": "mmd_paper",
    "chamfer_l1": "chamfer_l1",
    "f_score": "f_score",
}
IOUS = ("kato18", "kato19")

Results = dict[str, dict[int, dict[str, Any]]]  # by category and seed

PROTOCOL = {name: MEANINGS[key] for name, key in MEASURES.items()} | {
    "interval_seeds": f"{LEVEL:.0%} interval of the mean over seeds (Student's t)",
    "interval_objects": f"{LEVEL:.0%} interval over test objects: {RESAMPLES} resamples of objects, not images; the "
    "differences to the baseline are paired",
}


def make_report(
    table: Table, options: Options, runs: Sequence[Run], records: Mapping[Path, dict[str, Any]]
) -> dict[str, Any]:
    """The table's report from the stored results of runs, by folder; runs without one are named under "missing"."""
    categories = list(dict.fromkeys(run.category for run in runs))
    rows = selected_rows(table, options.methods)
    done = {row.label: _records_of(row, categories, runs, records) for row in rows}
    return {
        "table": table.name,
        "title": table.title,
        "note": table.note,
        "metric": table.metric,
        "baseline": table.baseline,
        "data": str(options.data),
        "output": str(options.output),
        "categories": categories,
        "protocol": PROTOCOL,
        "rows": [_row(table, row, categories, done[row.label], done.get(table.baseline)) for row in rows],
        "runs": [_run(run, records[run.folder]) for run in runs if run.folder in records],
        "missing": [run.name for run in runs if run.folder not in records],
    }


def _records_of(row: Row, categories: list[str], runs: Sequence[Run], records: Mapping[Path, dict]) -> Results:
    """Results of a row by category and seed."""
    mine = [run for run in runs if row.variant and run.variant.name == row.variant.name and run.folder in records]
    return {c: {run.seed: records[run.folder] for run in mine if run.category == c} for c in categories}


def _row(table: Table, row: Row, categories: list[str], results: Results, baseline: Results | None) -> dict[str, Any]:
    main, cells = "mmd" if table.metric == "mmd" else "kato18", {}
    for column, names in [*((c, [c]) for c in categories), (MEAN, categories)]:
        ours, theirs = (
            [found[name] for name in names] for found in (results, baseline or {name: {} for name in names})
        )
        cell = _cell(ours) if all(ours) else {}
        if cell and row.label != table.baseline and all(theirs):
            other = _cell(theirs)
            if main in cell["values"] and main in other["values"]:
                cell["to_baseline"] = _difference(main, cell, other) | _paired_bootstrap(main, ours, theirs)
        cells[column] = cell | _paper(row.published, column, categories)
    variant, published_row = row.variant, row.published
    return {
        "label": row.label,
        "variant": variant and variant.name,
        "preset": variant and variant.preset,
        "checkpoint": variant and variant.checkpoint,
        "metric": "mmd" if table.metric == "mmd" else published_row.metric if published_row else "kato18",
        "quoted_from": published_row and published_row.quoted_from,
        "published_note": published_row and published_row.note,
        "cells": cells,
    }


def _cell(ours: list[dict[int, dict]]) -> dict[str, Any]:
    """Our figures for one category, or their means over several, from results by seed."""
    seeds = sorted(set.intersection(*(set(by_seed) for by_seed in ours)))
    values, by_seed = {}, {}
    for name, key in MEASURES.items():
        per_category = [[record.get(key) for record in results.values()] for results in ours]
        if any(value is None for found in per_category for value in found):
            continue
        values[name] = float(np.mean([np.mean(found) for found in per_category]))
        by_seed[name] = [float(np.mean([results[seed][key] for results in ours])) for seed in seeds]
    first = [next(iter(results.values())) for results in ours]
    return {
        "values": values,
        "seeds": seeds,
        "by_seed": by_seed,
        "interval_seeds": {name: interval for name, found in by_seed.items() if (interval := t_interval(found))},
        "interval_objects": {name: percentile_interval(_resampled(name, ours)) for name in IOUS},
        "iterations": sorted({record["iterations"] for results in ours for record in results.values()}),
        "objects": sum(len(record["objects"]["names"]) for record in first),
        "images": sum(record["images"] for record in first),
    }


def _difference(metric: str, ours: dict[str, Any], theirs: dict[str, Any]) -> dict[str, Any]:
    """One cell minus the baseline's, with its interval over seeds (paired: the difference of each seed)."""
    a, b = ours["values"][metric], theirs["values"][metric]
    difference: dict[str, Any] = {"metric": metric, "value": a - b}
    if ours["seeds"] == theirs["seeds"]:
        pairs = zip(ours["by_seed"][metric], theirs["by_seed"][metric], strict=True)
        if interval := t_interval([x - y for x, y in pairs]):
            difference["interval_seeds"] = interval
    return difference | ({"ratio": a / b} if metric == "mmd" and b else {})


def _paired_bootstrap(metric: str, ours: list[dict[int, dict]], theirs: list[dict[int, dict]]) -> dict[str, Any]:
    """The interval of the difference of two IoUs over the same objects."""
    if metric == "mmd" or [_names(results) for results in ours] != [_names(results) for results in theirs]:
        return {}
    return {"interval_objects": percentile_interval(_resampled(metric, ours) - _resampled(metric, theirs))}


def _resampled(metric: str, ours: list[dict[int, dict]]) -> np.ndarray:
    """Means over resampled objects [2000]; the IoUs of an object are those of all seeds together."""
    sums, counts = [], []
    for results in ours:
        _check_objects(results)
        found = [object_sums(record, metric) for record in results.values()]
        sums.append(sum(s for s, _ in found))
        counts.append(sum(n for _, n in found))
    return resampled_means(sums, counts)


def _check_objects(results: dict[int, dict]) -> None:
    """Raise ValueError where seeds of a row were measured on different objects."""
    if any(record["objects"]["names"] != _names(results) for record in results.values()):
        raise ValueError(
            "these runs were measured on different test objects, so that they have no mean: "
            + "; ".join(f"seed {seed}: {record['command']}" for seed, record in results.items())
            + ". Were the data made anew in between? Choose another --output, or --overwrite"
        )


def _names(results: dict[int, dict]) -> list[str]:
    return next(iter(results.values()))["objects"]["names"]


def _paper(row: PublishedRow | None, column: str, categories: list[str]) -> dict[str, Any]:
    """The paper's figure for a column. The mean is taken over the same categories as ours wherever the paper has them;
    its printed mean stands beside it. A mean over other categories than ours is given, but not compared."""
    if row is None:
        return {}
    if column != MEAN:
        return {"paper": row.values[column]} if column in row.values else {}
    printed = {} if row.mean is None else {"paper_printed": row.mean}
    same = set(categories) == (set(row.values) or set(CATEGORIES))
    if same and row.mean is not None:
        return printed | {"paper": row.mean}
    if categories and all(name in row.values for name in categories):
        return printed | {"paper": float(np.mean([row.values[name] for name in categories]))}
    return printed


def _run(run: Run, record: dict[str, Any]) -> dict[str, Any]:
    """One line about a run, with all that repeats it."""
    kept = ("iterations", "step", "checkpoint", "seed", "seconds", "images", "undefined", "command")
    commit = (record.get("trained_by") or {}).get("commit")
    output = f"OUTPUT/runs/CATEGORY/{run.variant.name}-seedSEED"
    return {
        "run": run.name,
        "variant": run.variant.name,
        "category": run.category,
        **{name: record.get(name) for name in kept},
        "batch_size": run.config.batch_size,
        "objects": len(record["objects"]["names"]),
        **{name: record.get(key) for name, key in MEASURES.items()},
        "commit": commit and commit[:9] + "-dirty" * commit.endswith("-dirty"),
        "general_command": command_line(run.config, data="DATA", category="CATEGORY", seed="SEED", output=output),
    }
