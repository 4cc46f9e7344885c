"""Trained networks measured on a split: what `learn3d evaluate` prints and experiments store."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, Field, model_validator

from learn3d.config import config_to_dict
from learn3d.data.layouts import require_folder
from learn3d.evaluation import CODES_PER_VIEW, F_SCORE_DISTANCE, SURFACE_POINTS, Evaluation, evaluate
from learn3d.experiments.plan import command_line
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint
from learn3d.runs.versions import versions
from learn3d.settings import MOST, Step
from learn3d.terminal import align

VOXELISERS = ("kato18", "kato19")
DIGITS = 5  # of the IoU of an object or view

#: Header of each measure in tables, and its definition. A measure is a mean over images, then over classes.
MEASURES = {
    "voxel_iou_kato18": (
        "voxel IoU",
        "of predicted and true 32^3 grids, by the voxeliser of Kato et al. 2018, as in the paper",
    ),
    "voxel_iou_kato19": (
        "IoU (kato19)",
        "the same by that of Kato and Harada 2019: every cell that a face touches; not comparable",
    ),
    "precision": (
        "precision",
        "part of the predicted voxels (kato18) inside the true shape: low if shapes are too full",
    ),
    "recall": ("recall", "part of the true shape's voxels that is predicted: low if parts are missing"),
    "chamfer_l1": (
        "Chamfer-L1",
        f"mean distance of {SURFACE_POINTS} points of either surface to the other, units of the object; "
        "empty predictions are left out",
    ),
    "f_score": (
        "F-score",
        f"of the shares of these points within {F_SCORE_DISTANCE} of the other surface (harmonic mean), "
        "0 for an empty prediction",
    ),
    "silhouette_iou": (
        "silhouette IoU",
        "for data without voxels: with the mask of another image of the object, at its camera",
    ),
    "mmd": (
        "MMD",
        f"between the shape codes of two views, up to {CODES_PER_VIEW} each, mean over all pairs of views, by the "
        "published code (five kernels, no root): the smaller, the less a code depends on the view",
    ),
    "mmd_paper": ("MMD (printed formula)", "the same by the formula that the paper prints: one kernel, square root"),
}


def describe_measures() -> str:
    """One line for each column of figures of `format_table`."""
    width = max(len(header) for header, _ in MEASURES.values())
    return "\n".join(f"  {header:{width}}  {definition}" for header, definition in MEASURES.values())


Number = Annotated[float, Field(ge=-MOST, le=MOST)] | None
Amount = Annotated[int, Field(ge=0, le=10**9)]


class GroupMeans(BaseModel, strict=True):
    """Mean IoUs of the images of each object, or of each view."""

    names: list[str]
    images: list[Amount]
    defined: list[Amount]  # images whose IoU is defined
    kato18: list[Number]
    kato19: list[Number]

    @model_validator(mode="after")
    def _check_lengths(self) -> GroupMeans:
        if any(len(values) != len(self.names) for values in vars(self).values()):
            raise ValueError("the lists differ in length")
        return self

    def sums(self, voxeliser: str) -> tuple[np.ndarray, np.ndarray]:
        """(sum of the IoUs, number of IoUs), both float64 [N], of each object or view."""
        defined = np.array(self.defined, np.float64)
        return np.array([mean or 0.0 for mean in getattr(self, voxeliser)]) * defined, defined


class Result(BaseModel, strict=True):
    """The networks of one checkpoint, measured on one category and split. A measure without a value is None."""

    checkpoint: str  # file
    method: str  # label of the preset
    preset: str
    category: str
    split: str
    data: str
    config: dict[str, Any]
    command: str  # repeats the training
    iterations: Step  # of the whole training
    step: Amount  # of these networks
    seed: Amount
    seconds: Number  # of training
    fingerprint: dict[str, Any]  # of the training data
    trained_by: dict[str, str | None]  # versions
    tested_by: dict[str, str | None]
    images: Amount
    undefined: Amount  # images without an IoU: prediction and truth are empty
    hollow: Amount  # predicted meshes that reach beyond the voxel grid
    without_distance: Amount | None  # images without a Chamfer distance
    voxel_iou_kato18: Number
    voxel_iou_kato19: Number
    precision: Number
    recall: Number
    chamfer_l1: Number
    f_score: Number
    silhouette_iou: Number
    mmd: Number
    mmd_paper: Number
    objects: GroupMeans | None  # None for data without voxels
    views: GroupMeans | None

    @property
    def commit(self) -> str | None:
        """First nine digits of the commit that trained the run, with its mark for changed sources; None if unknown."""
        commit = self.trained_by.get("commit")
        return commit and commit[:9] + "-dirty" * commit.endswith("-dirty")


def measure(
    file: Path,
    *,
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    precision: Literal["bf16", "fp32"] = "fp32",
    device: str = "cpu",
    report_progress: Callable[[str], None] = lambda text: None,
) -> Result:
    """Measure a checkpoint on all images of a split; `data` and `category` default to those of the training."""
    method, config, metadata = checkpoint.load_method(file, device=device, precision=precision)
    label, category, data = PRESETS[config.preset].label, category or config.category, data or config.data
    report_progress(f"{file}: {label} ({config.preset}) on {category}, {split}")
    dataset = checkpoint.load_data(config, split, data=data, category=category)
    evaluation = evaluate(method, dataset, definitions=VOXELISERS, paper_mmd=True, surfaces=True)
    for warning in _warnings(evaluation):
        report_progress(f"warning: {warning}")
    has_voxels = bool(evaluation.ious)
    return Result(
        checkpoint=str(file),
        method=label,
        preset=config.preset,
        category=category,
        split=split,
        data=str(data.resolve()),
        config=config_to_dict(config),
        command=command_line(config),
        iterations=config.iterations,
        step=metadata.progress.step,
        seed=config.seed,
        seconds=metadata.progress.seconds,
        fingerprint=dataclasses.asdict(metadata.fingerprint),
        trained_by=metadata.versions,
        tested_by=versions(),
        objects=_means_by(evaluation.object_ids, evaluation.ious, dataset.object_names) if has_voxels else None,
        views=_means_by(evaluation.view_ids, evaluation.ious, dataset.view_names) if has_voxels else None,
        **dict.fromkeys(("voxel_iou_kato18", "voxel_iou_kato19"))
        | {name: value for name, value in evaluation.summary().items() if name in Result.model_fields},
    )


def _warnings(result: Evaluation) -> list[str]:
    """The images that the means leave out or count as hollow."""
    found = [f"{result.undefined} images have no IoU (both shapes are empty)"] if result.undefined else []
    if result.hollow:
        found.append(f"{result.hollow} predicted meshes reach beyond the grid of voxels, and count as hollow there")
    found += [result.without_mmd] if result.without_mmd else []
    if result.without_distance:
        found.append(f"{result.without_distance} images have no Chamfer distance (the predicted surface is empty)")
    return found


def _means_by(ids: torch.Tensor, ious: dict[str, torch.Tensor], names: tuple[str, ...]) -> GroupMeans:
    """Mean IoUs of the groups that occur in `ids`, int64 [M]; a group is an object or a view."""
    ids = ids.numpy()
    known = ~np.isnan(ious[VOXELISERS[0]].numpy())
    groups = np.unique(ids)
    defined = np.bincount(ids[known], minlength=len(names))[groups]
    means = {}
    for name in VOXELISERS:
        sums = np.bincount(ids[known], ious[name].numpy()[known], len(names))[groups]
        means[name] = [round(float(s / n), DIGITS) if n else None for s, n in zip(sums, defined, strict=True)]
    images = np.bincount(ids, minlength=len(names))[groups]
    return GroupMeans(
        names=[names[group] for group in groups], images=images.tolist(), defined=defined.tolist(), **means
    )


def evaluate_runs(
    paths: Sequence[Path],
    *,
    data: Path | None = None,
    category: str | None = None,
    which: Literal["last", "best"] = "last",
    **options: Any,
) -> list[Result]:
    """Measure run folders or checkpoint files (`which` of a folder), a run on several categories on each by itself.

    The options are those of `measure`. Raises ValueError or OSError before anything is measured if a checkpoint or a
    data folder is missing.
    """
    if not paths:
        raise ValueError("give at least one run folder or checkpoint to evaluate")
    found = {file: checkpoint.load_metadata(file).config for path in paths for file in [checkpoint.find(path, which)]}
    for config in found.values():
        require_folder(data or config.data)
    return [
        measure(file, data=data, category=name.strip(), **options)
        for file, config in found.items()
        for name in (category or config.category).split(",")
    ]


def to_json(results: Sequence[Result], **protocol: str) -> dict[str, Any]:
    """The results and their means over classes as plain values, with the definition of each measure."""
    definitions = {name: definition for name, (_, definition) in MEASURES.items()}
    values = [result.model_dump() for result in results]
    return {"protocol": protocol | definitions, "results": values, "means": class_means(results)}


def format_table(results: Sequence[Result]) -> str:
    """A text table: a line per result, then a mean over classes per method."""
    rows = [("class", "method", "seed", "iterations", "images", *(header for header, _ in MEASURES.values()))]
    for r in results:
        counts = (str(r.seed), str(r.step), str(r.images))
        rows.append((r.category, f"{r.method} ({r.preset})", *counts, *_figures(vars(r))))
    for m in class_means(results):
        classes = f"{m['classes']} classes" if m["classes"] > 1 else "1 class"
        rows.append(("mean", f"{m['method']} ({m['preset']})", "", "", classes, *_figures(m)))
    return align(rows)


def _figures(values: dict[str, Any]) -> list[str]:
    return ["-" if values[name] is None else f"{values[name]:.4f}" for name in MEASURES]


def class_means(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Mean over classes of each method's measures; results of the same class (seeds) are averaged first."""
    means = []
    for method, preset in dict.fromkeys((r.method, r.preset) for r in results):
        classes: dict[str, list[Result]] = {}
        for r in results:
            if (r.method, r.preset) == (method, preset):
                classes.setdefault(r.category, []).append(r)
        row: dict[str, Any] = {"method": method, "preset": preset, "classes": len(classes)}
        for name in MEASURES:
            row[name] = _mean([_mean([getattr(r, name) for r in same]) for same in classes.values()])
        means.append(row)
    return means


def _mean(values: list[float | None]) -> float | None:
    """Plain mean, or None if a value is missing."""
    return None if None in values else sum(values) / len(values)
