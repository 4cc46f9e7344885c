"""What a run measures and draws while it trains: IoU and MMD of the validation split, pictures of a few images."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from learn3d.config import TrainConfig
from learn3d.data.dataset import ViewDataset
from learn3d.evaluation import evaluate
from learn3d.figures.grids import picture_grid
from learn3d.methods import Method
from learn3d.pictures.sheets import save_png
from learn3d.runs.checkpoint import Progress
from learn3d.runs.folder import PICTURES
from learn3d.runs.log import RunLog, SilentLog
from learn3d.runs.state import Run

PICTURE_ROWS = 8


def validate(run: Run, val_set: ViewDataset, progress: Progress, log: RunLog | SilentLog) -> Progress:
    """Measure IoU and MMD on the validation images; keep the networks when their IoU is the best so far.

    It is the IoU of voxels; where no true shapes are known that of silhouettes, at cameras that were not the input's.
    Returns the progress with the best IoU and its step.
    """
    config, step = run.config, progress.step
    with run.method.ema_weights():
        result = evaluate(run.method, val_set, max_images=config.max_val_images)
    log.metrics(step, config.val_split, {k: v for k, v in result.summary().items() if v is not None})
    mmd = "" if result.mmd is None else f", MMD {result.mmd:.3f}"
    without = f"; {result.without_mmd}" if result.mmd is None else ""
    if without and result.images < len(val_set):
        without += f" (max_val_images {config.max_val_images})"
    kind, iou = result.chosen_by
    better = iou is not None and iou > progress.best_iou
    mark = " (best so far)" if better else ""
    shown = "undefined" if iou is None else f"{iou:.4f}"
    log.say(f"step {step}: {config.val_split} {kind} {shown}{mmd}{mark}{without}")
    if result.undefined:
        log.say(f"warning: {result.undefined} images have no IoU (prediction and truth are both empty); left out")
    if better:
        progress = dataclasses.replace(progress, best_iou=iou, best_step=step)
        run.save_best(progress)
    return progress


def draw(config: TrainConfig, method: Method, val_set: ViewDataset, step: int, log: RunLog) -> None:
    """Write pictures/<step>.png: the same few validation images every time, of different objects and views."""
    with method.ema_weights():
        grid = picture_grid(method, val_set, picture_samples(val_set, PICTURE_ROWS))
    folder = config.output / PICTURES
    try:
        folder.mkdir(exist_ok=True)
        save_png(folder / f"{step:06}.png", grid)
    except OSError as error:
        log.warn("pictures cannot be written", error, "training goes on")
    log.picture(step, config.val_split, grid)


def picture_samples(dataset: ViewDataset, count: int) -> Tensor:
    """Samples for pictures, int64 [count] or fewer: of objects spread over the set, each seen from another side."""
    rows = min(count, len(dataset))
    chosen = []
    for row, number in enumerate(np.linspace(0, dataset.num_objects - 1, rows).round().astype(int)):
        samples = np.flatnonzero(dataset.object_ids == number)
        if len(samples):
            chosen.append(samples[(row * 7 + 3) % len(samples)])
    return torch.from_numpy(np.array(chosen))
