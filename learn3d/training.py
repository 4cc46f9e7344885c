"""The training loop: configuration, data, networks, steps, validation, checkpoints."""

import dataclasses
import math
import time

from learn3d import distributed
from learn3d.config import TrainConfig
from learn3d.data.dataset import Batch, ViewDataset
from learn3d.data.mirror_plane import find_mirror_plane
from learn3d.data.sampling import VIEWS_OF_OBJECT, batches
from learn3d.device import ThreadTuner, keep_freed_memory, resolve_precision
from learn3d.evaluation import NO_MMD, evaluate, picture_grid, spread_samples
from learn3d.methods import create_method
from learn3d.methods.mesh_method import MeshMethod
from learn3d.methods.method import Losses, Method
from learn3d.methods.pose_updates import update_poses, update_steps
from learn3d.pictures import save_png
from learn3d.runs import folder as run_folder
from learn3d.runs.checkpoint import Progress, load_data
from learn3d.runs.log import RunLog, check_log, open_log
from learn3d.runs.run import Run, Summary, describe_images
from learn3d.terminal import stop_on_signal

PICTURE_ROWS = 8  # of the picture grids


def train(config: TrainConfig, *, resume: bool = False, overwrite: bool = False) -> Summary:
    """Train one model and save it in `config.output`; `runs.folder` lists the files there.

    SIGINT, SIGTERM and SIGHUP end the run after the current step, with a checkpoint. resume:
    continue from the last checkpoint (bit-identical on the same CPU with the same number of
    threads), or from the start if there is no checkpoint yet. A finished run is left unchanged.
    overwrite: replace an older run in the folder.

    Raises ValueError if the folder is not empty, if the data do not fit, or if options or data
    differ from those of the resumed run; FloatingPointError if a loss is not finite (the last
    checkpoint predates it); OSError if a checkpoint cannot be written or another process works in
    the folder.
    """
    started = time.monotonic()
    folder = config.output
    config = dataclasses.replace(
        config, precision=resolve_precision(config.precision, config.device)
    )
    check_log(config)
    keep_freed_memory()
    with ThreadTuner(config.threads) as threads, run_folder.lock_folder(folder):
        if not resume:
            run_folder.check_can_start(folder, overwrite)
        run, train_set, val_set = create_run(config)
        method = run.method
        # the data and a batch are checked before `begin` removes an older run
        empty_masks = train_set.check_masks()
        distributed.check_networks(method.networks)
        rows = distributed.own_rows(config.batch_size, VIEWS_OF_OBJECT[config.sampling])
        method.check_batch(next(batches(train_set, config, rows=rows)))
        progress, notes = run.begin(train_set, resume=resume, overwrite=overwrite)
        distributed.check_same(
            options=config, data=run.data, step=progress.step, versions=run.versions
        )
        distributed.synchronize(method.networks, method.optimizers.values())
        if progress.step == config.iterations:
            return Summary(folder, progress, True, time.monotonic() - started)
        estimated = train_set.candidates is not None and isinstance(method, MeshMethod)
        updates = update_steps(config.iterations, config.pose_updates if estimated else 0)
        seconds_before = progress.seconds
        first = progress.step + 1
        threads.resume(progress.threads)

        with (
            run_folder.advice_on_errors(folder),
            stop_on_signal() as stop,
            open_log(config, start=progress.step) as log,
        ):
            for warning in filter(None, (*notes, empty_masks)):
                log.say(f"warning: {warning}")
            log.say(run.describe(progress, train_set, val_set, threads))
            for step, batch in enumerate(batches(train_set, config, first, rows), first):
                step_began = time.monotonic()
                losses = take_step(method, batch, step)
                losses, stopped_by = distributed.mean_losses(losses, stop.name)
                if chosen := threads.after_step(time.monotonic() - step_began):
                    log.say(f"step {step}: {chosen}")
                # those of the last two steps, as some methods alternate between two networks
                recent = progress.losses | losses
                progress = dataclasses.replace(
                    progress,
                    step=step,
                    losses=losses,
                    threads=threads.chosen,
                    seconds=seconds_before + time.monotonic() - started,
                )
                log.step(step, losses)

                last = step == config.iterations
                if last or step % config.log_every == 0:
                    log.metrics(step, "train", recent)
                if step in updates:
                    changed = update_poses(method, train_set)
                    found = f"the best pose of {changed:.0%} of the images changed"
                    log.say(f"step {step}: poses reweighted; {found}")
                if last or step % config.validate_every == 0:
                    progress = validate(run, val_set, progress, log)
                if last or step % config.pictures_every == 0:
                    draw(config, method, val_set, step, log)
                if last or stopped_by or step % config.checkpoint_every == 0:
                    run.save(progress, log)
                if stopped_by and not last:
                    then = run_folder.resume_command(folder)
                    log.say(f"stopped by {stopped_by} after step {step}; continue with: {then}")
                    break
    return Summary(folder, progress, progress.step == config.iterations, time.monotonic() - started)


def create_run(config: TrainConfig) -> tuple[Run, ViewDataset, ViewDataset]:
    """The run of a configuration with its method, and its training and validation images.

    Raises ValueError if the method cannot learn from the data.
    """
    train_set = load_data(config, "train")
    val_set = load_data(config, config.val_split)
    settings = config.settings
    plane = find_mirror_plane(train_set) if settings.wants_mirror_plane else None
    solidity = train_set.solidity() if settings.wants_solidity else None
    info = train_set.info(plane, solidity)
    method = create_method(
        settings,
        info,
        device=config.device,
        precision=config.precision,
        seed=config.seed,
        schedule=config.schedule,
    )
    run = Run(config, method, info, describe_images(train_set), train_set.candidates)
    return run, train_set, val_set


def take_step(method: Method, batch: Batch, step: int) -> dict[str, float]:
    """Take training step `step` (from 1).

    Returns its losses before weighting, and "total", their weighted sum.

    Raises FloatingPointError if a loss is not finite, before its gradient is computed.
    """
    optimizers = method.optimizers
    factor = method.schedule.lr_factor(step)
    for optimizer in optimizers.values():
        for group in optimizer.param_groups:
            group["lr"] = factor * group.setdefault("initial_lr", group["lr"])
    values: dict[str, float] = {}
    total = 0.0
    # one phase with the method's `losses` and all optimizers; PrGAN has several
    for losses, names in method.phases(batch, step):
        values |= loss_values(losses, step)
        total += sum(weight * values[name] for name, (weight, _) in losses.items())
        weighted = sum(weight * loss for weight, loss in losses.values())
        (weighted / distributed.world_size()).backward()
        for name in names:
            optimizers[name].step()
        for optimizer in optimizers.values():
            optimizer.zero_grad()
    if method.ema is not None:
        method.ema.update(step)
    return values | {"total": total}


def loss_values(losses: Losses, step: int) -> dict[str, float]:
    """The losses as numbers, before weighting. Raises FloatingPointError if one is not finite."""
    values = {name: float(loss.detach()) for name, (_, loss) in losses.items()}
    if not all(math.isfinite(value) for value in values.values()):
        listed = ", ".join(f"{name} {value:g}" for name, value in values.items())
        raise FloatingPointError(f"the loss is not finite at iteration {step} ({listed})")
    return values


def validate(run: Run, val_set: ViewDataset, progress: Progress, log: RunLog) -> Progress:
    """Measure IoU and MMD on the validation images; save the networks with the best IoU.

    `Evaluation.selection_metric` says which IoU. Returns the progress with the best IoU and its
    step.
    """
    config = run.config
    step = progress.step
    result = evaluate(run.method, val_set, max_images=config.max_val_images)
    log.metrics(step, config.val_split, result.means)
    metric = result.selection_metric
    iou = result.means.get(metric)
    shown = "undefined" if iou is None else f"{iou:.4f}"
    mmd = f"MMD {result.means['mmd']:.3f}" if "mmd" in result.means else NO_MMD
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
    """Write pictures/<step>.png: the same few validation images each time."""
    if distributed.rank() > 0:
        return
    samples = spread_samples(val_set.object_ids, val_set.view_ids, PICTURE_ROWS)
    grid = picture_grid(method, val_set, samples)
    folder = config.output / run_folder.PICTURES
    folder.mkdir(exist_ok=True)
    save_png(folder / f"{step:06}.png", grid)
    log.picture(step, config.val_split, grid)
