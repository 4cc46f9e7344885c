"""The training loop: configuration, data, networks, steps, validation, checkpoints. It reads from top to bottom."""

from __future__ import annotations

import contextlib
import dataclasses
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
from learn3d.data.augment import augment
from learn3d.data.layouts import load_dataset
from learn3d.data.sampling import sample_indices
from learn3d.data.views import ViewDataset
from learn3d.evaluation import evaluate
from learn3d.memory import keep_freed_memory
from learn3d.methods import DataShape, Method, create_method
from learn3d.networks import resolve_precision
from learn3d.presets import PRESETS
from learn3d.runlog import RunLog
from learn3d.versions import versions

CONFIG_FILE = "config.json"
PICTURE_ROWS = 8


@dataclass
class Progress:
    """Where a run stands."""

    step: int = 0  # steps taken
    best_iou: float = -1.0  # best validation voxel IoU so far; -1 before the first validation
    best_step: int = 0
    seconds: float = 0.0  # spent in training, over all resumptions
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
        _claim_folder(folder, overwrite)
    if progress.step >= config.iterations:
        raise ValueError(
            f"{folder} has taken {progress.step} steps of {config.iterations} already; "
            "to continue ask for more iterations"
        )
    files.write_json(folder / CONFIG_FILE, config_to_dict(config))
    before = progress.seconds

    with _stop_on_signal() as stop, RunLog(folder, start=progress.step, total=config.iterations) as log:
        log.say(_describe(config, precision, train_set, val_set, progress))
        for step in range(progress.step + 1, config.iterations + 1):
            indices = sample_indices(train_set, config.sampling, config.batch_size, config.seed, step)
            batch = augment(train_set.batch(indices), config.augment, config.seed, step)
            try:
                losses = method.train_step(batch, step)
            except FloatingPointError as error:
                raise FloatingPointError(f"{error}; {_last_good(folder)}") from None
            progress.step = step
            progress.seconds = before + time.monotonic() - started
            log.step(step, losses)

            last = step == config.iterations
            if last or step % config.log_every == 0:
                log.metrics(step, "train", losses)
            if last or step % config.validate_every == 0:
                _validate(config, method, shape, val_set, progress, log)
            if last or step % config.pictures_every == 0:
                _draw(config, method, val_set, step, log)
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


def _validate(
    config: TrainConfig,
    method: Method,
    shape: DataShape,
    val_set: ViewDataset,
    progress: Progress,
    log: RunLog,
) -> None:
    """Measure voxel IoU and MMD on the validation images; keep the networks when they are the best so far.

    A data set without true shapes has no best: its MMD alone says nothing about the shapes.
    """
    result = evaluate(method, val_set, max_images=config.max_val_images)
    log.metrics(progress.step, config.val_split, {k: v for k, v in result.summary().items() if v is not None})
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
        metadata = checkpoint.method_metadata(shape, config) | dataclasses.asdict(progress)
        _check_networks(method, config.output)
        checkpoint.save(config.output / "best.safetensors", checkpoint.network_tensors(method), metadata)


def _draw(config: TrainConfig, method: Method, val_set: ViewDataset, step: int, log: RunLog) -> None:
    """Write pictures/<step>.png: the same few validation images every time, of different objects and views."""
    grid = figures.picture_grid(method, val_set, picture_samples(val_set, PICTURE_ROWS))
    folder = config.output / "pictures"
    folder.mkdir(exist_ok=True)
    figures.save_png(folder / f"{step:06}.png", grid)
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


def save_last(
    folder: Path,
    config: TrainConfig,
    conditions: Conditions,
    method: Method,
    shape: DataShape,
    progress: Progress,
) -> None:
    """Write last.safetensors: networks, optimizers, random state, progress, configuration, conditions and versions."""
    _check_networks(method, folder)
    tensors = checkpoint.network_tensors(method) | {"random.cpu": torch.get_rng_state()}
    if config.device == "cuda":
        tensors["random.cuda"] = torch.cuda.get_rng_state()
    for name, optimizer in method.optimizers.items():
        tensors |= checkpoint.optimizer_tensors(name, optimizer)
    metadata = checkpoint.method_metadata(shape, config) | dataclasses.asdict(progress)
    metadata |= {"conditions": dataclasses.asdict(conditions), "versions": versions()}
    checkpoint.save(folder / "last.safetensors", tensors, metadata)


def restore(
    path: Path,
    config: TrainConfig,
    conditions: Conditions,
    method: Method,
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
    checkpoint.restore_networks(method, tensors, path)
    for name, optimizer in method.optimizers.items():
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


def _check_networks(method: Method, folder: Path) -> None:
    """Refuse to save networks that are no longer finite: the checkpoint on disk is better than they are."""
    for name, network in method.networks.items():
        if not all(bool(parameter.isfinite().all()) for parameter in network.parameters()):
            raise FloatingPointError(f"the {name} has weights that are not finite; {_last_good(folder)}")


def _last_good(folder: Path) -> str:
    path = folder / "last.safetensors"
    if not path.is_file():
        return "there is no checkpoint yet; try a lower learning_rate or precision fp32"
    return f"the last good checkpoint is {path}; try a lower learning_rate or precision fp32"


def _describe(config: TrainConfig, precision: str, train_set: ViewDataset, val_set: ViewDataset, at: Progress) -> str:
    where = f"{config.device}, {precision}, {torch.get_num_threads()} threads"
    data = f"{len(train_set)} images of {train_set.num_objects} objects; {config.val_split}: {len(val_set)} images"
    verb = f"resuming at step {at.step}" if at.step else "training"
    name = f"{PRESETS[config.preset].label} ({config.preset})"
    return f"{verb}: {name} on {config.category}, {data}; {where}; output {config.output}"
