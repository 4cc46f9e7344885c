"""The training loop: configuration, data, networks, steps, validation, checkpoints. It reads from top to bottom."""

from __future__ import annotations

import contextlib
import dataclasses
import time
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from learn3d.config import TrainConfig, config_to_dict
from learn3d.data.augment import augment
from learn3d.data.dataset import ViewDataset
from learn3d.data.layouts import load_dataset
from learn3d.data.sampling import sample_indices
from learn3d.device import keep_freed_memory, resolve_precision
from learn3d.files import writing
from learn3d.interrupt import stop_on_signal
from learn3d.methods import DataShape, Method, create_method
from learn3d.parallel.ranks import ALONE, Ranks, weights_digest
from learn3d.presets import PRESETS
from learn3d.runs import folder as run_folder
from learn3d.runs.faults import explained
from learn3d.runs.log import RunLog, SilentLog
from learn3d.runs.pace import CoreShare
from learn3d.runs.state import Conditions, Progress, load_last, restore, save_last
from learn3d.validation import draw, validate


@dataclass(frozen=True)
class Summary:
    """How a call of `train` ended."""

    folder: Path
    step: int
    finished: bool  # False when a signal stopped it
    best_iou: float
    best_step: int
    seconds: float  # of this call
    total_seconds: float  # of training, over all resumptions
    was_finished: bool = False  # before this call

    def __str__(self) -> str:
        """How it ended, in a line."""
        if self.was_finished:
            end = f"was already finished at step {self.step}"
        else:
            end = f"{'finished' if self.finished else 'stopped'} at step {self.step} after {self.seconds / 60:.1f} min"
            if self.total_seconds > self.seconds + 1:
                end += f" ({self.total_seconds / 60:.1f} min of training in all)"
        best = f"best validation IoU {self.best_iou:.4f} at step {self.best_step}; " if self.best_step else ""
        return f"{end}; {best}everything is in {self.folder}"


def train(config: TrainConfig, *, resume: bool = False, overwrite: bool = False, ranks: Ranks = ALONE) -> Summary:
    """Train one model and leave everything in `config.output`.

    What the folder holds afterwards is listed in `run_folder`. SIGINT, SIGTERM and SIGHUP end the current step, save
    and return. With `resume` the run continues from its last checkpoint, bit for bit (same machine, device and numbers
    of threads and processes), or from the start if it was stopped before its first one. A finished run stays as it is.

    Several processes, each with its `ranks`, train one model together (`parallel.ranks`); the first one writes.

    Raises ValueError for a folder in use, options or training data that conflict with the resumed run or data that do
    not fit, FloatingPointError when a loss is no longer finite (the last checkpoint is from before that), OSError when
    a checkpoint cannot be written or another process works in the folder, MemoryError when there is too little memory.
    """
    with run_folder.sole_use(config.output) if ranks.main else contextlib.nullcontext():
        return _train(config, resume, overwrite, ranks)


def _train(config: TrainConfig, resume: bool, overwrite: bool, ranks: Ranks) -> Summary:
    started = time.monotonic()
    keep_freed_memory()
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if ranks.main and not resume:
        run_folder.check_free(config.output, overwrite)  # before data are read; it is cleared when all else is well
    ranks = ranks.divide(config.batch_size, config.sampling)
    train_set, val_set = load_splits(config)
    precision = resolve_precision(config.precision, config.device)
    folder, saved = config.output, None
    if resume:
        with ranks.main_first():  # it may have to put an earlier checkpoint in place
            saved = load_last(folder, config, repair=ranks.main)
    # A run goes on as it began, also one from before encoders could turn colours back.
    inverted = train_set.inverted if saved is None else saved.shape.inverted
    shape = DataShape(train_set.num_views, train_set.num_classes, train_set.pose_features, inverted)
    method = create_method(
        config.settings, shape, device=config.device, precision=precision, seed=config.seed, plan=config.plan
    )
    if saved is None:
        method.start_from_pretrained()
    progress = Progress(object_share=object_share(train_set))
    conditions = Conditions(len(train_set), f"{zlib.crc32(np.ascontiguousarray(train_set.images)):08x}", precision)
    if saved is not None:
        restore(saved, config, conditions, method, progress)
    empty = _check_masks(train_set)
    notes = () if saved is None else saved.notes
    del saved  # and its tensors
    if ranks.main and resume:
        run_folder.remove_partials(folder)
    if progress.step > config.iterations:
        raise ValueError(f"{folder} has taken {progress.step} steps, more than the {config.iterations} asked for")
    if progress.step == config.iterations:  # also after a kill between the last save and the end
        if ranks.main:
            run_folder.remove_old(folder, progress.step, config.keep_checkpoints)
        return dataclasses.replace(_summary(folder, config, progress, started), was_finished=True)
    method.join(ranks)
    ranks.check_same(**_beginning(config, conditions, train_set, val_set, method, progress))
    if ranks.main:
        if not resume:
            run_folder.claim(folder, overwrite)
        writing.write_json(folder / run_folder.CONFIG, config_to_dict(config), sync=True)
    before = progress.seconds
    waits = config.device != "cpu" or not ranks.alone
    cores = CoreShare(torch.get_num_threads(), processes=ranks.local_world, waits=waits)

    with explained(folder), stop_on_signal() as stop, _open_log(config, progress, ranks) as log:
        for note in (*notes, *empty):
            log.say(f"warning: {note}")
        log.say(_describe(config, precision, train_set, val_set, progress, ranks))
        for step in range(progress.step + 1, config.iterations + 1):
            indices = sample_indices(train_set, config.sampling, config.batch_size, config.seed, step)
            batch = augment(train_set.batch(indices, ranks.rows, voxels=False), config.augment, config.seed, step)
            losses = method.train_step(batch, step)
            progress.step = step
            progress.seconds = before + time.monotonic() - started
            # With those of the step before: methods that take turns compute other ones in odd and in even steps.
            recent, progress.losses = progress.losses | losses, losses
            log.step(step, recent)
            if warning := cores.warning():
                log.say(f"warning: {warning}")
            stopped_by = ranks.stopped_by(stop)

            last = step == config.iterations
            if last or step % config.log_every == 0:
                log.metrics(step, "train", recent)
            if last or step % config.validate_every == 0:
                validate(config, method, shape, val_set, progress, log)
            if ranks.main and (last or step % config.pictures_every == 0):
                draw(config, method, val_set, step, log)
            if last or stopped_by or step % config.checkpoint_every == 0:
                ranks.check_same(weights=weights_digest(method.networks) if ranks.world > 1 else 0)
                if ranks.main:
                    log.sync()
                    save_last(folder, config, conditions, method, shape, progress)
            if stopped_by and not last:
                then = run_folder.resume_command(folder)
                log.say(f"stopped by {stopped_by} after step {step}; continue with: {then}")
                break
        summary = _summary(folder, config, progress, started)
        log.note(str(summary))

    return summary


def _summary(folder: Path, config: TrainConfig, at: Progress, started: float) -> Summary:
    finished = at.step == config.iterations
    seconds = time.monotonic() - started
    return Summary(folder, at.step, finished, at.best_iou, at.best_step, seconds, at.seconds)


def load_splits(config: TrainConfig) -> tuple[ViewDataset, ViewDataset]:
    """The training and the validation split of a run. Both have the same view classes."""
    options = {"image_size": config.settings.image_size, "view_bins": config.view_bins}
    where = (config.layout, config.data, config.category)
    train_set = load_dataset(*where, "train", views_per_object=config.views_per_object, **options)
    return train_set, load_dataset(*where, config.val_split, **options)


def _check_masks(dataset: ViewDataset) -> tuple[str, ...]:
    """What to warn about; raises ValueError where no image shows anything."""
    masks = dataset.images[:, 3] if dataset.masks is None else dataset.masks
    empty = len(masks) - int(masks.any(axis=(1, 2)).sum())
    if empty == len(masks):
        raise ValueError(
            f"all {empty} {dataset.split} images of {dataset.category} have an empty mask, so that there is nothing to "
            "learn; look at the data (learn3d check-dataset)"
        )
    return (f"{empty} of {len(masks)} {dataset.split} images have an empty mask",) if empty else ()


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


def _open_log(config: TrainConfig, progress: Progress, ranks: Ranks) -> RunLog | SilentLog:
    return RunLog(config.output, start=progress.step, total=config.iterations) if ranks.main else SilentLog()


def _beginning(
    config: TrainConfig,
    conditions: Conditions,
    train_set: ViewDataset,
    val_set: ViewDataset,
    method: Method,
    progress: Progress,
) -> dict[str, object]:
    """What must be the same in all processes when they begin, by the name that a user knows it by."""
    if method.ranks.alone:
        return {}
    options = dataclasses.replace(config, data=Path(), output=Path(), threads=None)
    return {
        "options": config_to_dict(options),
        "precision": conditions.precision,
        "training data": (conditions, train_set.digest()),
        "validation data": (len(val_set), val_set.digest()),
        "steps taken": progress.step,
        "weights": weights_digest(method.networks),
    }


def _describe(
    config: TrainConfig, precision: str, train_set: ViewDataset, val_set: ViewDataset, at: Progress, ranks: Ranks
) -> str:
    where = f"{config.device}, {precision}, {torch.get_num_threads()} threads"
    if not ranks.alone:
        where += f" in each of {ranks.world} processes ({ranks.backend})"
    data = f"{len(train_set)} images of {train_set.num_objects} objects; {config.val_split}: {len(val_set)} images"
    verb = f"resuming at step {at.step}" if at.step else "training"
    name = f"{PRESETS[config.preset].label} ({config.preset})"
    return f"{verb}: {name} on {config.category}, {data}; {where}; output {config.output}"
