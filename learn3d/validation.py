"""Validation during training: IoU and MMD of the validation split, and pictures of a few images."""

from __future__ import annotations

import dataclasses

from learn3d.config import TrainConfig
from learn3d.data.dataset import ViewDataset
from learn3d.evaluation import NO_MMD, evaluate, spread_samples
from learn3d.figures.grids import picture_grid
from learn3d.methods import Method
from learn3d.pictures.sheets import save_png
from learn3d.runs.checkpoint import Progress
from learn3d.runs.folder import PICTURES
from learn3d.runs.log import RunLog
from learn3d.runs.run import Run

PICTURE_ROWS = 8


def validate(run: Run, val_set: ViewDataset, progress: Progress, log: RunLog) -> Progress:
    """Measure IoU and MMD on the validation images; save the networks if their IoU is the best so far.

    `Evaluation.selection_metric` says which IoU. Returns the progress with the best IoU and its step.
    """
    config, step = run.config, progress.step
    result = evaluate(run.method, val_set, max_images=config.max_val_images)
    log.metrics(step, config.val_split, result.means)
    metric = result.selection_metric
    iou = result.means.get(metric)
    shown = "undefined" if iou is None else f"{iou:.4f}"
    mmd = NO_MMD if result.mmd is None else f"MMD {result.mmd:.3f}"
    if iou is not None and iou > progress.best_iou:
        shown += " (best so far)"
        progress = dataclasses.replace(progress, best_iou=iou, best_step=step)
        run.save_best(progress)
    shown = f"{metric.replace('_iou', ' IoU')} {shown}"
    if metric != "voxel_iou" and result.voxel_iou is not None:
        shown += f", voxel IoU {result.voxel_iou:.4f}"
    log.say(f"step {step}: {config.val_split} {shown}, {mmd}")
    return progress


def draw(config: TrainConfig, method: Method, val_set: ViewDataset, step: int, log: RunLog) -> None:
    """Write pictures/<step>.png: the same few validation images of different objects and views each time."""
    samples = spread_samples(val_set.object_ids, val_set.view_ids, PICTURE_ROWS)
    grid = picture_grid(method, val_set, samples)
    folder = config.output / PICTURES
    folder.mkdir(exist_ok=True)
    save_png(folder / f"{step:06}.png", grid)
    log.picture(step, config.val_split, grid)
