"""The training loop: configuration, data, networks, steps, validation, checkpoints. It reads from top to bottom."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import shlex
import shutil
import signal
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from learn3d import checkpoint, figures, files
from learn3d.config import TrainConfig, check_resume, config_from_dict, config_to_dict
from learn3d.data.kato import KatoDataset
from learn3d.evaluation import evaluate
from learn3d.memory import keep_freed_memory
from learn3d.methods.pose_invariant import Optimizers, create_optimizers, train_step, uses_discriminator
from learn3d.networks import Networks, create_networks, resolve_precision
from learn3d.runlog import RunLog

CONFIG_FILE = "config.json"
PICTURE_ROWS = 8


@dataclass
class Progress:
    """Where a run stands."""

    step: int = 0  # steps taken
    best_iou: float = -1.0  # best validation voxel IoU so far; -1 before the first validation
    best_step: int = 0
    object_share: float = 0.0  # side of the objects' bounding squares over that of the pictures, training mean


@dataclass(frozen=True)
class Conditions:
    """What decides the next steps besides the options and the saved state; a resumed run must find it as it was."""

    samples: int  # training images: their number decides the order
    images: str  # CRC-32 of the training images, as stored
    precision: str  # bf16 or fp32: what "auto" came to


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
    train_set = KatoDataset.load(config.data, config.category, "train")
    val_set = KatoDataset.load(config.data, config.category, config.val_split)
    settings = config.loss_settings()
    precision = resolve_precision(config.precision, config.device)

    networks = create_networks(
        train_set.num_views, discriminator=uses_discriminator(settings), device=config.device, seed=config.seed
    )
    optimizers = create_optimizers(networks, config.learning_rate)
    progress = Progress(object_share=object_share(train_set))
    conditions = Conditions(len(train_set), f"{zlib.crc32(np.ascontiguousarray(train_set.images)):08x}", precision)
    folder = config.output
    if resume:
        restore(folder / "last.safetensors", config, conditions, networks, optimizers, progress)
    else:
        _claim_folder(folder, overwrite)
    if progress.step >= config.iterations:
        raise ValueError(
            f"{folder} has taken {progress.step} steps of {config.iterations} already; "
            "to continue ask for more iterations"
        )
    files.write_json(folder / CONFIG_FILE, config_to_dict(config))

    with _stop_on_signal() as stop, RunLog(folder, start=progress.step, total=config.iterations) as log:
        log.say(_describe(config, precision, train_set, val_set, progress))
        for step in range(progress.step + 1, config.iterations + 1):
            indices = batch_indices(len(train_set), config.batch_size, config.seed, step)
            try:
                losses = train_step(networks, optimizers, train_set.batch(indices), step, settings, precision)
            except FloatingPointError as error:
                raise FloatingPointError(f"{error}; {_last_good(folder)}") from None
            progress.step = step
            log.step(step, losses)

            last = step == config.iterations
            if last or step % config.log_every == 0:
                log.metrics(step, "train", losses)
            if last or step % config.validate_every == 0:
                _validate(config, networks, val_set, precision, progress, log)
            if last or step % config.pictures_every == 0:
                _draw(config, networks, val_set, step, log)
            if last or stop.requested or step % config.checkpoint_every == 0:
                save_last(folder, config, conditions, networks, optimizers, progress)
            if stop.requested and not last:
                log.say(f"stopped by {stop.name} after step {step}; continue with: {resume_command(folder)}")
                break

    seconds = time.monotonic() - started
    finished = progress.step == config.iterations
    return Summary(folder, progress.step, finished, progress.best_iou, progress.best_step, seconds)


def batch_indices(num_samples: int, batch_size: int, seed: int, step: int) -> Tensor:
    """Samples of step `step` (from 1), int64 [batch_size]: the next ones of an endless row of shuffled epochs.

    A function of its arguments alone, so that a resumed run needs no memory of the data's position.
    """
    positions = range((step - 1) * batch_size, step * batch_size)
    pieces = []
    for epoch in range(positions.start // num_samples, (positions.stop - 1) // num_samples + 1):
        first = max(positions.start - epoch * num_samples, 0)
        end = min(positions.stop - epoch * num_samples, num_samples)
        pieces.append(_epoch_order(num_samples, seed, epoch)[first:end])
    return torch.cat(pieces)


@functools.lru_cache(maxsize=2)
def _epoch_order(num_samples: int, seed: int, epoch: int) -> Tensor:
    generator = torch.Generator().manual_seed((seed * 1_000_003 + epoch) % 2**63)
    return torch.randperm(num_samples, generator=generator)


def object_share(dataset: KatoDataset) -> float:
    """Mean over the images of the larger side of the mask's bounding box, as a share of the picture's side.

    Kept in checkpoints, so that photographs can be framed like the images that the networks know.
    """
    masks = dataset.images[:, :, 3].reshape(len(dataset), *dataset.images.shape[-2:]) > 127
    sides = []
    for axis in (1, 2):
        seen = masks.any(axis=axis)
        size = seen.shape[1]
        first, last = seen.argmax(axis=1), size - 1 - seen[:, ::-1].argmax(axis=1)
        sides.append(np.where(seen.any(axis=1), last - first + 1, 0) / size)
    return float(np.maximum(*sides).mean())


def _validate(
    config: TrainConfig,
    networks: Networks,
    val_set: KatoDataset,
    precision: str,
    progress: Progress,
    log: RunLog,
) -> None:
    """Measure voxel IoU and MMD on the validation images; keep the networks when they are the best so far."""
    result = evaluate(networks, val_set, precision=precision, max_images=config.max_val_images)
    log.metrics(progress.step, config.val_split, {k: v for k, v in dataclasses.asdict(result).items() if v is not None})
    mmd = "" if result.mmd is None else f", MMD {result.mmd:.3f}"
    iou = -1.0 if result.voxel_iou is None else result.voxel_iou
    better = iou > progress.best_iou
    mark = " (best so far)" if better else ""
    shown = "undefined" if result.voxel_iou is None else f"{iou:.4f}"
    log.say(f"step {progress.step}: {config.val_split} voxel IoU {shown}{mmd}{mark}")
    if result.undefined:
        log.say(f"warning: {result.undefined} images have no IoU (prediction and truth are both empty); left out")
    if better:
        progress.best_iou, progress.best_step = iou, progress.step
        metadata = checkpoint.networks_metadata(networks, config) | dataclasses.asdict(progress)
        _check_networks(networks, config.output)
        checkpoint.save(config.output / "best.safetensors", checkpoint.network_tensors(networks), metadata)


def _draw(config: TrainConfig, networks: Networks, val_set: KatoDataset, step: int, log: RunLog) -> None:
    """Write pictures/<step>.png: the same few validation images every time, of different objects and views."""
    rows = min(PICTURE_ROWS, len(val_set))
    objects = torch.linspace(0, val_set.num_objects - 1, rows).round().long()
    views = (torch.arange(rows) * 7 + 3) % val_set.num_views
    grid = figures.picture_grid(networks, val_set, objects * val_set.num_views + views)
    folder = config.output / "pictures"
    folder.mkdir(exist_ok=True)
    figures.save_png(folder / f"{step:06}.png", grid)
    log.picture(step, config.val_split, grid)


def save_last(
    folder: Path,
    config: TrainConfig,
    conditions: Conditions,
    networks: Networks,
    optimizers: Optimizers,
    progress: Progress,
) -> None:
    """Write last.safetensors: networks, optimizers, random state, progress, configuration and conditions."""
    _check_networks(networks, folder)
    tensors = checkpoint.network_tensors(networks) | {"random.cpu": torch.get_rng_state()}
    if config.device == "cuda":
        tensors["random.cuda"] = torch.cuda.get_rng_state()
    for name, optimizer in optimizers.items():
        tensors |= checkpoint.optimizer_tensors(name, optimizer)
    metadata = checkpoint.networks_metadata(networks, config) | dataclasses.asdict(progress)
    metadata["conditions"] = dataclasses.asdict(conditions)
    checkpoint.save(folder / "last.safetensors", tensors, metadata)


def restore(
    path: Path,
    config: TrainConfig,
    conditions: Conditions,
    networks: Networks,
    optimizers: Optimizers,
    progress: Progress,
) -> None:
    """Bring everything back to the state that `save_last` wrote.

    An option or a condition that differs is a ValueError that names it. Conditions that an older checkpoint does not
    record are not checked.
    """
    tensors, metadata = checkpoint.load(path)
    saved, recorded = config_from_dict(metadata["config"], source=str(path)), metadata.get("conditions", {})
    if recorded.get("precision") == conditions.precision:  # asked for by name or by "auto", it is the same
        saved = dataclasses.replace(saved, precision=config.precision)
    check_resume(config, saved)
    _check_conditions(conditions, recorded, config.data)
    checkpoint.restore_networks(networks, tensors, path)
    for name, optimizer in optimizers.items():
        checkpoint.restore_optimizer(name, optimizer, tensors)
    for field in dataclasses.fields(Progress):
        setattr(progress, field.name, metadata.get(field.name, getattr(progress, field.name)))
    torch.set_rng_state(tensors["random.cpu"])
    if config.device == "cuda" and "random.cuda" in tensors:
        torch.cuda.set_rng_state(tensors["random.cuda"])


def _check_conditions(now: Conditions, recorded: dict[str, object], data: Path) -> None:
    """Raise a ValueError naming what differs from the conditions that a checkpoint recorded."""
    then = dataclasses.replace(now, **recorded)
    if then.precision != now.precision:
        raise ValueError(
            f"cannot resume: the run computes in {then.precision}, but precision 'auto' means {now.precision} here; "
            f"ask for precision {then.precision}"
        )
    if then.samples != now.samples:
        raise ValueError(
            f"cannot resume with other training data: {then.samples} images in the run, {now.samples} in {data}; "
            "give the run's own data set, or start a new run"
        )
    if then.images != now.images:
        raise ValueError(
            f"cannot resume with other training data: the CRC-32 of the images was {then.images}, that of {data} is "
            f"{now.images}; give the run's own data set, or start a new run"
        )


def resume_command(folder: Path) -> str:
    """The command line that continues the run in `folder`, quoted for a POSIX shell."""
    return f"python tools/train.py --output {shlex.quote(str(folder))} --resume"


@dataclass
class _Stop:
    requested: bool = False
    name: str = ""


@contextlib.contextmanager
def _stop_on_signal() -> Iterator[_Stop]:
    """Turn the first SIGINT or SIGTERM into a request to stop; a second SIGINT interrupts at once."""
    stop = _Stop()

    def handle(number: int, frame: object) -> None:
        if stop.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        stop.requested, stop.name = True, signal.Signals(number).name

    previous: dict[int, object] = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            with contextlib.suppress(ValueError):  # not the main thread: leave signals alone
                previous[number] = signal.signal(number, handle)
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _claim_folder(folder: Path, overwrite: bool) -> None:
    """Make the run's folder; one with something in it is refused, or with `overwrite` cleared of an earlier run."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"output {folder} is a file; give a folder for the run")
    if folder.is_dir() and any(folder.iterdir()):
        if not overwrite:
            raise ValueError(
                f"{folder} is not empty; continue that run (--resume), replace it (--overwrite) "
                "or choose another folder"
            )
        for name in (CONFIG_FILE, "last.safetensors", "best.safetensors", "metrics.jsonl"):
            (folder / name).unlink(missing_ok=True)
        for name in ("tensorboard", "pictures"):
            shutil.rmtree(folder / name, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)


def _check_networks(networks: Networks, folder: Path) -> None:
    """Refuse to save networks that are no longer finite: the checkpoint on disk is better than they are."""
    for name, network in networks.items():
        if not all(bool(parameter.isfinite().all()) for parameter in network.parameters()):
            raise FloatingPointError(f"the {name} has weights that are not finite; {_last_good(folder)}")


def _last_good(folder: Path) -> str:
    path = folder / "last.safetensors"
    if not path.is_file():
        return "there is no checkpoint yet; try a lower learning_rate or precision fp32"
    return f"the last good checkpoint is {path}; try a lower learning_rate or precision fp32"


def _describe(config: TrainConfig, precision: str, train_set: KatoDataset, val_set: KatoDataset, at: Progress) -> str:
    where = f"{config.device}, {precision}, {torch.get_num_threads()} threads"
    data = f"{len(train_set)} images of {train_set.num_objects} objects; {config.val_split}: {len(val_set)} images"
    verb = f"resuming at step {at.step}" if at.step else "training"
    return f"{verb}: {config.method} ({config.preset}) on {config.category}, {data}; {where}; output {config.output}"
