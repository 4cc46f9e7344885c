"""The report of `learn3d evaluate`: trained runs measured on a split, as JSON and as a text table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from learn3d.data.layouts import require_folder
from learn3d.evaluation import CODES_PER_VIEW, F_SCORE_DISTANCE, SURFACE_POINTS, Evaluation, evaluate
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint
from learn3d.runs.versions import versions
from learn3d.terminal import align

COLUMNS = {
    "voxel_iou_kato18": "voxel IoU",
    "voxel_iou_kato19": "IoU (kato19)",
    "precision": "precision",
    "recall": "recall",
    "chamfer_l1": "Chamfer-L1",
    "f_score": "F-score",
    "silhouette_iou": "silhouette IoU",
    "mmd": "MMD",
    "mmd_paper": "MMD (printed formula)",
}
#: What each of them is. They are means over the images, each on its own, then over the classes.
MEANINGS = {
    "voxel_iou_kato18": "of predicted and true 32^3 grids, by the voxeliser of Kato et al. 2018, as in the paper",
    "voxel_iou_kato19": "the same by that of Kato and Harada 2019: every cell that a face touches; not comparable",
    "precision": "part of the predicted voxels (kato18) that is in the true shape: low where shapes are too full",
    "recall": "part of the true shape's voxels that is predicted: low where parts are missing",
    "chamfer_l1": f"mean distance of {SURFACE_POINTS} points of either surface to the other, units of the object; "
    "none for an empty prediction, which is left out",
    "f_score": f"of the shares of these points within {F_SCORE_DISTANCE} of the other surface (harmonic mean), "
    "0 for an empty prediction",
    "silhouette_iou": "for data without voxels: with the mask of another image of the object, at its camera",
    "mmd": f"of the shape codes of two views, up to {CODES_PER_VIEW} each, mean over all pairs of views, by the "
    "published code: five kernels, no root; the smaller, the less a code tells of the view",
    "mmd_paper": "the same by the formula that the paper prints: one kernel, square root",
}


def describe_columns() -> str:
    """A line for each column of figures of `format_table`."""
    return "\n".join(f"  {COLUMNS[key]}: {text}" for key, text in MEANINGS.items())


def evaluate_runs(
    paths: Sequence[Path],
    *,
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    which: Literal["last", "best"] = "last",
    precision: Literal["bf16", "fp32"] = "fp32",
    device: str = "cpu",
    report_progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Evaluate run folders or checkpoint files on a split; a report ready for JSON, see `format_table`.

    `data` and `category` default to those each run was trained with; a run on several categories is measured on each of
    them by itself. The mean over classes is taken per method; several runs of one class and method (seeds) count as one
    class. Raises ValueError or OSError before anything is measured where a checkpoint or a folder of data is not there.
    """
    if not paths:
        raise ValueError("give at least one run folder or checkpoint to evaluate")
    found = [checkpoint.find(path, which) for path in paths]
    for file in found:
        _check(file, data)
    results = []
    for file in found:
        method, config, metadata = checkpoint.load_method(file, device=device, precision=precision)
        folder = data or config.data
        for name in (part.strip() for part in (category or config.category).split(",")):
            report_progress(f"{file}: {PRESETS[config.preset].label} ({config.preset}) on {name}, {split}")
            dataset = checkpoint.load_data(config, split, data=folder, category=name)
            result = evaluate(method, dataset, definitions=("kato18", "kato19"), paper_mmd=True, surfaces=True)
            for warning in _warnings(result):
                report_progress(f"warning: {warning}")
            about = {
                "checkpoint": str(file),
                "category": name,
                "data": str(folder),
                "method": PRESETS[config.preset].label,
                "preset": config.preset,
                "iterations": metadata.progress.step,
                "seed": config.seed,
                "trained_by": metadata.versions,
            }
            results.append(about | result.summary())
    protocol = {"split": split, "checkpoint": which, "precision": precision, **MEANINGS}
    return {"protocol": protocol, "versions": versions(), "results": results, "means": _class_means(results)}


def _warnings(result: Evaluation) -> list[str]:
    """What is not in the means."""
    found = [f"{result.undefined} images have no IoU (both shapes are empty)"] if result.undefined else []
    if result.hollow:
        found.append(f"{result.hollow} predicted meshes reach beyond the grid of voxels, and count as hollow there")
    found += [result.without_mmd] if result.without_mmd else []
    if result.without_distance:
        found.append(f"{result.without_distance} images have no Chamfer distance (the predicted surface is empty)")
    return found


def _check(file: Path, data: Path | None) -> None:
    """Raise an error where a checkpoint, or the folder of its data, is not there; only its header is read."""
    metadata = checkpoint.load_metadata(file)
    require_folder(data or metadata.config.data)


def format_table(report: dict[str, Any]) -> str:
    """The report of `evaluate_runs` as a text table: a line per run, then a mean over classes per method."""
    header = ("class", "method", "seed", "iterations", "images", *COLUMNS.values())
    rows = [header]
    for r in report["results"]:
        label = f"{r['method']} ({r['preset']})"
        counts = (str(r["seed"]), str(r["iterations"]), str(r["images"]))
        rows.append((r["category"], label, *counts, *(_number(r.get(key)) for key in COLUMNS)))
    for m in report["means"]:
        label, classes = f"{m['method']} ({m['preset']})", f"{m['classes']} classes" if m["classes"] > 1 else "1 class"
        rows.append(("mean", label, "", "", classes, *(_number(m[key]) for key in COLUMNS)))
    return align(rows)


def _class_means(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean over classes of each method's figures; runs of the same class are averaged first."""
    means = []
    for method, preset in dict.fromkeys((r["method"], r["preset"]) for r in results):
        classes: dict[str, list[dict[str, Any]]] = {}
        for r in results:
            if (r["method"], r["preset"]) == (method, preset):
                classes.setdefault(r["category"], []).append(r)
        row: dict[str, Any] = {"method": method, "preset": preset, "classes": len(classes)}
        row |= {key: _mean([_mean([r.get(key) for r in of_one]) for of_one in classes.values()]) for key in COLUMNS}
        means.append(row)
    return means


def _mean(values: list[float | None]) -> float | None:
    """Plain mean, or None when a value is missing."""
    return None if None in values else sum(values) / len(values)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
