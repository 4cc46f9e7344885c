"""The training loop: configuration, data, networks, steps, validation, checkpoints. It reads from top to bottom."""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from learn3d import files
from learn3d.config import TrainConfig, config_to_dict
from learn3d.data.augment import augment
from learn3d.data.layouts import load_dataset
from learn3d.data.sampling import sample_indices
from learn3d.data.views import ViewDataset
from learn3d.memory import keep_freed_memory
from learn3d.methods import DataShape, create_method
from learn3d.networks import resolve_precision
from learn3d.presets import PRESETS
from learn3d.run_state import (
    CONFIG_FILE,
    Conditions,
    Progress,
    claim_folder,
    last_good,
    restore,
    resume_command,
    save_last,
)
from learn3d.runlog import RunLog
from learn3d.signals import stop_on_signal
from learn3d.validation import draw, validate


@dataclass(frozen=True)
class Summary:
    """How a call of `train` ended."""

    folder: Path
    step: int
    finished: bool  # False when a signal stopped it
    best_iou: float
    best_step: int
    seconds: float


def train(config: TrainConfig, *, resume: bool = False, overwrite: bool = False) -> Summary:
    """Train one model and leave everything in `config.output`.

    The folder receives config.json, last.safetensors (all that a resumption needs), best.safetensors (the networks with
    the best validation IoU), metrics.jsonl, tensorboard/ and pictures/. SIGINT and SIGTERM end the current step, save
    and return. With `resume` the run continues from last.safetensors, bit for bit (same machine, device and number of
    threads).

    Raises ValueError for a folder in use, options or training data that conflict with the resumed run or data that do
    not fit, FloatingPointError when a loss is no longer finite (the last checkpoint is from before that), and OSError
    when something cannot be written.
    """
    started = time.monotonic()
    keep_freed_memory()
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    train_set, val_set = load_splits(config)
    precision = resolve_precision(config.precision, config.device)
    shape = DataShape(train_set.num_views, train_set.num_classes, train_set.poses.num_features)
    method = create_method(config.settings, shape, device=config.device, precision=precision, seed=config.seed)
    progress = Progress(object_share=object_share(train_set))
    conditions = Conditions(len(train_set), f"{zlib.crc32(np.ascontiguousarray(train_set.images)):08x}", precision)
    folder = config.output
    if resume:
        restore(folder / "last.safetensors", config, conditions, method, progress)
    else:
        claim_folder(folder, overwrite)
    if progress.step >= config.iterations:
        raise ValueError(
            f"{folder} has taken {progress.step} steps of {config.iterations} already; "
            "to continue ask for more iterations"
        )
    files.write_json(folder / CONFIG_FILE, config_to_dict(config))
    before = progress.seconds

    with stop_on_signal() as stop, RunLog(folder, start=progress.step, total=config.iterations) as log:
        log.say(_describe(config, precision, train_set, val_set, progress))
        for step in range(progress.step + 1, config.iterations + 1):
            indices = sample_indices(train_set, config.sampling, config.batch_size, config.seed, step)
            batch = augment(train_set.batch(indices, voxels=False), config.augment, config.seed, step)
            try:
                losses = method.train_step(batch, step)
            except FloatingPointError as error:
                raise FloatingPointError(f"{error}; {last_good(folder)}") from None
            progress.step = step
            progress.seconds = before + time.monotonic() - started
            log.step(step, losses)

            last = step == config.iterations
            if last or step % config.log_every == 0:
                log.metrics(step, "train", losses)
            if last or step % config.validate_every == 0:
                validate(config, method, shape, val_set, progress, log)
            if last or step % config.pictures_every == 0:
                draw(config, method, val_set, step, log)
            if last or stop.requested or step % config.checkpoint_every == 0:
                save_last(folder, config, conditions, method, shape, progress)
            if stop.requested and not last:
                log.say(f"stopped by {stop.name} after step {step}; continue with: {resume_command(folder)}")
                break

    seconds = time.monotonic() - started
    finished = progress.step == config.iterations
    return Summary(folder, progress.step, finished, progress.best_iou, progress.best_step, seconds)


def load_splits(config: TrainConfig) -> tuple[ViewDataset, ViewDataset]:
    """The training and the validation split of a run. Both have the same view classes."""
    options = {"image_size": config.settings.image_size, "view_bins": config.view_bins}
    where = (config.layout, config.data, config.category)
    train_set = load_dataset(*where, "train", views_per_object=config.views_per_object, **options)
    return train_set, load_dataset(*where, config.val_split, **options)


def object_share(dataset: ViewDataset) -> float:
    """Mean over the images of the larger side of the mask's bounding box, as a share of the picture's side.

    Kept in checkpoints, so that photographs can be framed like the images that the networks know.
    """
    masks = dataset.images[:, 3] > 127
    sides = []
    for axis in (1, 2):
        seen = masks.any(axis=axis)
        size = seen.shape[1]
        first, last = seen.argmax(axis=1), size - 1 - seen[:, ::-1].argmax(axis=1)
        sides.append(np.where(seen.any(axis=1), last - first + 1, 0) / size)
    return float(np.maximum(*sides).mean())


def _describe(config: TrainConfig, precision: str, train_set: ViewDataset, val_set: ViewDataset, at: Progress) -> str:
    where = f"{config.device}, {precision}, {torch.get_num_threads()} threads"
    data = f"{len(train_set)} images of {train_set.num_objects} objects; {config.val_split}: {len(val_set)} images"
    verb = f"resuming at step {at.step}" if at.step else "training"
    name = f"{PRESETS[config.preset].label} ({config.preset})"
    return f"{verb}: {name} on {config.category}, {data}; {where}; output {config.output}"
