"""A table from stored results: the paper's figures beside ours, with confidence intervals, as plain values.

The paper's figures are of other meshes, so no difference to them is taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from learn3d.experiments.measurement import MEASURES, VOXELISERS, Result
from learn3d.experiments.plan import PlannedRun, Request, command_line, selected_rows
from learn3d.experiments.published import CATEGORIES, PublishedRow
from learn3d.experiments.statistics import LEVEL, RESAMPLES, percentile_interval, resampled_means, t_interval
from learn3d.experiments.tables import TABLES, VARIANTS, Table

MEAN = "mean"  # the column after the categories
_NAMES = ("voxel_iou_kato18", "voxel_iou_kato19", "mmd", "mmd_paper", "chamfer_l1", "f_score")
FIGURES = {name.removeprefix("voxel_iou_"): name for name in _NAMES}  # name in a report -> field of a result
PROTOCOL = {figure: MEASURES[name][1] for figure, name in FIGURES.items()} | {
    "interval_seeds": f"{LEVEL:.0%} interval of the mean over seeds (Student's t)",
    "interval_objects": f"{LEVEL:.0%} interval over test objects: {RESAMPLES} resamples of objects, not images; the "
    "differences to the baseline are paired",
}

BySeed = dict[int, Result]


def make_report(request: Request, runs: Sequence[PlannedRun], results: Mapping[Path, Result]) -> dict[str, Any]:
    """The report of a table from the stored results of runs, by folder; runs without one are named under "missing"."""
    table = TABLES[request.table]
    categories = list(dict.fromkeys(run.category for run in runs))
    rows = selected_rows(table, request.table, request.methods)
    measured = {
        label: {
            category: {
                run.seed: results[run.folder]
                for run in runs
                if (run.variant, run.category) == (variant, category) and run.folder in results
            }
            for category in categories
        }
        for label, variant in rows.items()
    }
    return {
        "table": request.table,
        "title": table.title,
        "note": table.note,
        "metric": table.metric,
        "baseline": table.baseline,
        "data": str(request.data),
        "output": str(request.output),
        "categories": categories,
        "protocol": PROTOCOL,
        "rows": [_make_row(table, label, variant, measured) for label, variant in rows.items()],
        "runs": [_describe_run(run, results[run.folder]) for run in runs if run.folder in results],
        "missing": [run.name for run in runs if run.folder not in results],
    }


def _make_row(
    table: Table, label: str, variant: str | None, measured: Mapping[str, dict[str, BySeed]]
) -> dict[str, Any]:
    published = table.published.get(label)
    metric = "mmd" if table.metric == "mmd" else "kato18"
    ours, baseline = measured[label], measured.get(table.baseline, {})
    categories, cells = list(ours), {}
    for column in [*categories, MEAN]:
        names = categories if column == MEAN else [column]
        cell, other = (_summarise([results.get(name, {}) for name in names]) for results in (ours, baseline))
        if label != table.baseline and metric in cell.get("values", {}) and metric in other.get("values", {}):
            cell["to_baseline"] = _compare(metric, cell, other, [ours[n] for n in names], [baseline[n] for n in names])
        cells[column] = cell | _published_figure(published, column, categories)
    return {
        "label": label,
        "variant": variant,
        "preset": variant and VARIANTS[variant].preset,
        "checkpoint": variant and VARIANTS[variant].checkpoint,
        "metric": "mmd" if table.metric == "mmd" else published.metric if published else "kato18",
        "quoted_from": published and published.quoted_from,
        "published_note": published and published.note,
        "cells": cells,
    }


def _summarise(categories: list[BySeed]) -> dict[str, Any]:
    """Our figures for one category, or their means over several; {} if one of them has no result."""
    if not all(categories):
        return {}
    seeds = sorted(set.intersection(*(set(by_seed) for by_seed in categories)))
    values, by_seed = {}, {}
    for figure, name in FIGURES.items():
        found = [[getattr(result, name) for result in results.values()] for results in categories]
        if any(None in of_category for of_category in found):
            continue
        values[figure] = float(np.mean([np.mean(of_category) for of_category in found]))
        by_seed[figure] = [float(np.mean([getattr(results[s], name) for results in categories])) for s in seeds]
    first = [next(iter(results.values())) for results in categories]
    return {
        "values": values,
        "seeds": seeds,
        "by_seed": by_seed,
        "interval_seeds": {figure: interval for figure, v in by_seed.items() if (interval := t_interval(v))},
        "interval_objects": {name: percentile_interval(_resample(name, categories)) for name in VOXELISERS},
        "iterations": sorted({result.iterations for results in categories for result in results.values()}),
        "objects": sum(len(result.objects.names) for result in first),
        "images": sum(result.images for result in first),
    }


def _compare(
    metric: str, ours: dict[str, Any], theirs: dict[str, Any], our_results: list[BySeed], their_results: list[BySeed]
) -> dict[str, Any]:
    """One cell minus the baseline's; intervals are paired, by seed and by object."""
    a, b = ours["values"][metric], theirs["values"][metric]
    difference: dict[str, Any] = {"metric": metric, "value": a - b}
    if ours["seeds"] == theirs["seeds"]:
        pairs = zip(ours["by_seed"][metric], theirs["by_seed"][metric], strict=True)
        if interval := t_interval([x - y for x, y in pairs]):
            difference["interval_seeds"] = interval
    if metric == "mmd":
        return difference | ({"ratio": a / b} if b else {})
    if [_object_names(results) for results in our_results] == [_object_names(results) for results in their_results]:
        resampled = _resample(metric, our_results) - _resample(metric, their_results)
        difference["interval_objects"] = percentile_interval(resampled)
    return difference


def _resample(voxeliser: str, categories: list[BySeed]) -> np.ndarray:
    """Mean IoUs over resampled objects [2000]; the IoUs of an object are those of all seeds together.

    Raises ValueError if seeds were measured on different objects.
    """
    sums, counts = [], []
    for results in categories:
        if any(result.objects.names != _object_names(results) for result in results.values()):
            commands = "; ".join(f"seed {seed}: {result.command}" for seed, result in results.items())
            raise ValueError(
                "these runs were measured on different test objects, so that they have no mean: "
                f"{commands}. Were the data made anew in between? Choose another --output, or --overwrite"
            )
        of_seeds = [result.objects.sums(voxeliser) for result in results.values()]
        sums.append(sum(total for total, _ in of_seeds))
        counts.append(sum(number for _, number in of_seeds))
    return resampled_means(sums, counts)


def _object_names(results: BySeed) -> list[str]:
    return next(iter(results.values())).objects.names


def _published_figure(row: PublishedRow | None, column: str, categories: list[str]) -> dict[str, Any]:
    """The paper's figure for a column, under "paper".

    Its mean is taken over the same categories as ours; the printed mean is added as "paper_printed". If the paper lacks
    one of our categories, its printed mean is given, but not compared.
    """
    if row is None:
        return {}
    if column != MEAN:
        return {"paper": row.values[column]} if column in row.values else {}
    printed = {} if row.mean is None else {"paper_printed": row.mean}
    if row.mean is not None and set(categories) == (set(row.values) or set(CATEGORIES)):
        return printed | {"paper": row.mean}
    if categories and all(name in row.values for name in categories):
        return printed | {"paper": float(np.mean([row.values[name] for name in categories]))}
    return printed


def _describe_run(run: PlannedRun, result: Result) -> dict[str, Any]:
    """One run with its figures and the commands that repeat it, with and without its folders."""
    kept = ("iterations", "step", "seed", "seconds", "images", "undefined", "command", "commit")
    output = f"OUTPUT/runs/CATEGORY/{run.variant}-seedSEED"
    return {
        "run": run.name,
        "variant": run.variant,
        "category": run.category,
        "checkpoint": run.checkpoint,
        **{name: getattr(result, name) for name in kept},
        "batch_size": run.config.batch_size,
        "objects": len(result.objects.names),
        **{figure: getattr(result, name) for figure, name in FIGURES.items()},
        "general_command": command_line(run.config, data="DATA", category="CATEGORY", seed="SEED", output=output),
    }
