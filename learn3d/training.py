"""The training loop: configuration, data, networks, steps, validation, checkpoints. It reads from top to bottom."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from learn3d.config import TrainConfig
from learn3d.data.dataset import ViewDataset
from learn3d.data.layouts import load_dataset
from learn3d.data.mirror_plane import find_mirror_plane
from learn3d.data.sampling import batches
from learn3d.device import keep_freed_memory, oversubscription_warning, resolve_precision
from learn3d.distributed.process_group import SINGLE_PROCESS, ProcessGroup
from learn3d.methods import create_method
from learn3d.presets import PRESETS
from learn3d.runs import folder as run_folder
from learn3d.runs.checkpoint import Progress
from learn3d.runs.faults import advice_on_errors
from learn3d.runs.log import RunLog, SilentLog
from learn3d.runs.state import Run, fingerprint_of
from learn3d.terminal import is_watched, stop_on_signal
from learn3d.validation import draw, validate


def train(
    config: TrainConfig, *, resume: bool = False, overwrite: bool = False, group: ProcessGroup = SINGLE_PROCESS
) -> Summary:
    """Train one model and leave everything in `config.output`.

    What the folder holds afterwards is listed in `runs.folder`. SIGINT, SIGTERM and SIGHUP end the current step, save
    and return. With `resume` the run continues from its last checkpoint (bit for bit on a CPU: same machine, numbers of
    threads and processes), or from the start if it was stopped before its first one. A finished run stays as it is.

    Several processes, each with its own `group`, train one model together; rank 0 writes.

    Raises ValueError for a folder in use, options or training data that conflict with the resumed run or data that do
    not fit, FloatingPointError when a loss is no longer finite (the last checkpoint is from before that), OSError when
    a checkpoint cannot be written or another process works in the folder, MemoryError when there is too little memory.
    """
    started, folder = time.monotonic(), config.output
    keep_freed_memory()
    if config.threads is not None:
        torch.set_num_threads(config.threads)

    with run_folder.lock_folder(folder) if group.is_main else contextlib.nullcontext():
        if group.is_main and not resume:
            run_folder.check_can_start(folder, overwrite)  # it is cleared when all else is well
        group = group.split_batch(config.batch_size, config.sampling)

        train_set, val_set = load_splits(config, progress=group.is_main)
        found = (
            *train_set.notes,
            *val_set.notes,
            train_set.check_masks(),
            oversubscription_warning(torch.get_num_threads(), group.local_world_size),
        )
        info = train_set.info(find_mirror_plane(train_set) if config.settings.wants_mirror_plane else None)
        precision = resolve_precision(config.precision, config.device)
        how = {"device": config.device, "precision": precision, "seed": config.seed, "schedule": config.schedule}
        method = create_method(config.settings, info, **how)
        method.check_batch(next(batches(train_set, config, rows=group.rows)))  # before an older run is cleared away
        run = Run(config, method, info, fingerprint_of(train_set, precision), group)
        progress, notes = run.begin(train_set, val_set, resume=resume, overwrite=overwrite)
        if progress.step == config.iterations:  # also after a kill between the last save and the end
            return dataclasses.replace(_summary(config, progress, started), was_finished=True)
        before = progress.seconds

        with advice_on_errors(folder), stop_on_signal() as stop, _open_log(config, progress, group) as log:
            for warning in filter(None, (*notes, *found)):
                log.say(f"warning: {warning}")
            log.say(_describe(config, precision, train_set, val_set, progress, group))
            if config.settings.wants_mirror_plane:
                log.say(_about_plane(info.mirror_plane_deg))
            start = progress.step + 1
            for step, batch in enumerate(batches(train_set, config, start, group.rows), start):
                losses = method.take_step(batch, step)
                # With the losses of the step before: some methods train one network in odd steps, another in even ones.
                recent = progress.losses | losses
                seconds = before + time.monotonic() - started
                progress = dataclasses.replace(progress, step=step, losses=losses, seconds=seconds)
                log.step(step, losses)

                last, stopped_by = step == config.iterations, group.stopped_by(stop)
                if last or step % config.log_every == 0:
                    log.metrics(step, "train", recent)
                if last or step % config.validate_every == 0:
                    progress = validate(run, val_set, progress, log)
                if group.is_main and (last or step % config.pictures_every == 0):
                    draw(config, method, val_set, step, log)
                if last or stopped_by or step % config.checkpoint_every == 0:
                    run.save(progress, log)
                if stopped_by and not last:
                    then = run_folder.resume_command(folder)
                    log.say(f"stopped by {stopped_by} after step {step}; continue with: {then}")
                    break
            summary = _summary(config, progress, started)
            log.note(str(summary))
    return summary


def load_splits(config: TrainConfig, *, progress: bool = False) -> tuple[ViewDataset, ViewDataset]:
    """The training and the validation split of a run. Both have the same view classes.

    progress: on a terminal, show a bar where many files are read.
    """
    options = {"image_size": config.settings.image_size, "view_bins": config.view_bins}
    load = functools.partial(load_dataset, config.layout, config.data, config.category, **options)
    progress = progress and is_watched()
    train_set = load("train", views_per_object=config.views_per_object, progress=progress)
    return train_set, load(config.val_split)


def _about_plane(plane_deg: float | None) -> str:
    """What the symmetry "auto" came to."""
    if plane_deg is None:
        return (
            "no mirror plane: the masks show none (it takes some 150 from all around), so shapes are not mirrored; "
            "--symmetry names a plane"
        )
    return f"mirror plane: the one that a camera of azimuth {plane_deg:g} looks along, as the masks show"


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


def _summary(config: TrainConfig, at: Progress, started: float) -> Summary:
    finished, seconds = at.step == config.iterations, time.monotonic() - started
    return Summary(config.output, at.step, finished, at.best_iou, at.best_step, seconds, at.seconds)


def _open_log(config: TrainConfig, progress: Progress, group: ProcessGroup) -> RunLog | SilentLog:
    return RunLog(config.output, start=progress.step, total=config.iterations) if group.is_main else SilentLog()


def _describe(
    config: TrainConfig, precision: str, train_set: ViewDataset, val_set: ViewDataset, at: Progress, group: ProcessGroup
) -> str:
    where = f"{config.device}, {precision}, {torch.get_num_threads()} threads"
    if group.world_size > 1:
        where += f" in each of {group.world_size} processes ({group.backend})"
    data = f"{len(train_set)} images of {train_set.num_objects} objects; {config.val_split}: {len(val_set)} images"
    verb = f"resuming at step {at.step}" if at.step else "training"
    name = f"{PRESETS[config.preset].label} ({config.preset})"
    return f"{verb}: {name} on {config.category}, {data}; {where}; output {config.output}"
