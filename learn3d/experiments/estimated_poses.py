"""The tables of estimated poses that the runs of an experiment are trained on, and how good they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from learn3d.config import TrainConfig
from learn3d.experiments.measurement import Result
from learn3d.experiments.plan import PlannedRun
from learn3d.files import limits
from learn3d.files.reading import parse_json, read_bytes
from learn3d.files.writing import write_json
from learn3d.poses.estimate import PoseOptions
from learn3d.poses.views import CameraOptions, compare, estimate_views, load_views
from learn3d.terminal import note

_CANDIDATES = 4
_HEADER = ["category", "seed", "Acc@30", "median error, degrees", "flips", "objects flipped"]
_HEADER += ["mean confidence", "IoU, known poses", "IoU, estimated poses", "ratio"]


def estimate_poses(config: TrainConfig) -> None:
    """Make the table of a run with the run's seed, unless it is there. Beside it is a JSON file with its errors.

    The table is turned into the frame of the data by the one angle that fits the validation images best.
    """
    if config.poses.is_file():
        return
    datasets = load_views(config.layout, config.data, config.category, config.views_per_object)
    views = estimate_views(datasets, CameraOptions(), PoseOptions(seed=config.seed), _CANDIDATES)
    comparison = compare(views)
    note(comparison.text())
    config.poses.parent.mkdir(parents=True, exist_ok=True)
    confidence = {"confidence": float(views.table.confidence.mean())}
    write_json(config.poses.with_suffix(".json"), dataclasses.asdict(comparison) | confidence)
    views.table.turned(comparison.offset_deg).write(config.poses)


def pose_rows(runs: Sequence[PlannedRun], results: Mapping[Path, Result]) -> list[list[str]]:
    """A table: errors of the poses of each category and seed, and IoUs of the run on them and of that on known ones."""
    known = {(r.config.category, r.config.seed): r.folder for r in runs if r.config.poses is None}
    rows, means = [], {}
    for run in (run for run in runs if run.config.poses is not None):
        pair = known.get((run.config.category, run.config.seed)), run.folder
        if not all(folder in results for folder in pair):
            continue
        path = run.config.poses.with_suffix(".json")
        errors = parse_json(read_bytes(path, limits.JSON_BYTES, "the errors of a table of poses as JSON"))
        ious = [results[folder].voxel_iou for folder in pair]
        names = ("accuracy", "median_deg", "flips", "objects_flipped", "confidence")
        values = [*(errors[name] for name in names), *ious, ious[1] / ious[0]]
        rows.append([run.config.category, str(run.config.seed), *_format(values)])
        means.setdefault(run.config.category, []).append(values)
    several = {category: values for category, values in means.items() if len(values) > 1}
    rows += [[category, "mean", *_format(np.mean(values, axis=0))] for category, values in several.items()]
    return [_HEADER, *rows] if rows else []


def _format(values: Sequence[float]) -> list[str]:
    return [f"{value:.1f}" if place == 1 else f"{value:.3f}" for place, value in enumerate(values)]
