"""The state of a run: what is saved to continue it bit for bit, and the conditions that it must find again."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from learn3d.config import TrainConfig, check_resume, config_from_dict, load_config
from learn3d.methods import DataShape, Method
from learn3d.runs import checkpoint, checkpoint_checks
from learn3d.runs import folder as run_folder
from learn3d.runs.folder import BEST, CONFIG, LAST
from learn3d.runs.versions import versions


@dataclass
class Progress:
    """Where a run stands."""

    step: int = 0  # steps taken
    best_iou: float = -1.0  # best validation IoU so far, see `validate`; -1 before the first validation
    best_step: int = 0
    seconds: float = 0.0  # spent in training, over all resumptions
    object_share: float = 0.0  # side of the objects' bounding squares over that of the pictures, training mean
    losses: dict[str, float] = dataclasses.field(default_factory=dict)  # of the last step


@dataclass(frozen=True)
class Conditions:
    """What decides the next steps besides the options and the saved state; a resumed run must find it as it was."""

    samples: int  # training images: their number decides the order
    images: str  # CRC-32 of the training images, as stored
    precision: str  # bf16 or fp32: what "auto" came to


@dataclass(frozen=True, eq=False)
class Saved:
    """A checkpoint that a run goes on from."""

    path: Path
    tensors: dict[str, Tensor]
    metadata: dict[str, Any]
    notes: tuple[str, ...] = ()  # what was wrong with newer ones

    @property
    def shape(self) -> DataShape:
        """What the run's networks were made for."""
        return checkpoint.data_shape(self.metadata)


def save_last(
    folder: Path,
    config: TrainConfig,
    conditions: Conditions,
    method: Method,
    shape: DataShape,
    progress: Progress,
) -> None:
    """Write last.safetensors: networks, optimizers, random state, progress, configuration, conditions and versions.

    A complete file has that name at every moment; the ones before it are kept as `config.keep_checkpoints` says.
    Raises FloatingPointError, with nothing written, for values that are not finite, as they could not be resumed from.
    """
    check_networks(method)
    tensors = (
        checkpoint.network_tensors(method) | checkpoint.average_tensors(method) | {"random.cpu": torch.get_rng_state()}
    )
    if config.device == "cuda":
        tensors["random.cuda"] = torch.cuda.get_rng_state()
    for name, optimizer in method.optimizers.items():
        state = checkpoint.optimizer_tensors(name, optimizer)
        _check_finite(f"the optimizer of the {name}", state)
        tensors |= state
    metadata = checkpoint.method_metadata(shape, config) | dataclasses.asdict(progress)
    metadata |= {"conditions": dataclasses.asdict(conditions), "versions": versions()}
    if config.keep_checkpoints > 1:
        run_folder.keep_previous(folder)
    checkpoint.save(folder / LAST, tensors, metadata)
    run_folder.remove_old(folder, progress.step, config.keep_checkpoints)


def load_last(folder: Path, config: TrainConfig, *, repair: bool = True) -> Saved | None:
    """The newest checkpoint of the run in `folder` that is whole, or None where the run was stopped before its first.

    A damaged last.safetensors is put aside and the one before it takes its place; `notes` say so. Without `repair`
    nothing is renamed, and a damaged one is an error: of several processes only the first one repairs, before the
    others look. Raises ValueError where there is no run, or one without a checkpoint that began with other options than
    `config`, DamagedError where there are checkpoints, but none of them is whole, and OSError where one cannot be
    reached.
    """
    candidates = run_folder.checkpoints(folder)
    if not candidates and not (folder / CONFIG).is_file():
        raise ValueError(f"there is no checkpoint and no {CONFIG} in {folder}; start the run without --resume")
    notes: list[str] = []
    for path in candidates:
        try:
            tensors, metadata = checkpoint.load(path)
        except checkpoint.DamagedError as error:
            if not repair:
                raise
            notes.append(str(error))
            continue
        checkpoint_checks.require_run(metadata, path)
        if path.name != LAST and repair:
            run_folder.put_in_place(path)
            notes.append(f"going on from the checkpoint before it, {path}; the steps since then are repeated")
        return Saved(path, tensors, metadata, tuple(notes))
    if candidates:
        left = f"; {BEST} can still be evaluated" if _reached_by(folder / BEST) else ""
        raise checkpoint.DamagedError(
            "; ".join(notes) + f"; no checkpoint is whole: start a new run (--overwrite){left}"
        )
    began = load_config(folder / CONFIG)
    check_resume(config, began)
    if (reached := _reached_by(folder / BEST)) > began.checkpoint_every:
        raise ValueError(
            f"the run in {folder} came to step {reached} at least ({BEST}), but its checkpoints are missing: put "
            f"{LAST} or one of {run_folder.EARLIER}/ back, or replace the run (--overwrite)"
        )
    return None


def _reached_by(path: Path) -> int:
    """The step of a checkpoint; 0 where there is none that can be read."""
    try:
        return checkpoint.load_metadata(path).get("step", 0)
    except ValueError:
        return 0


def restore(saved: Saved, config: TrainConfig, conditions: Conditions, method: Method, progress: Progress) -> None:
    """Bring everything back to the state that `save_last` wrote.

    An option or a condition that differs is a ValueError that names it. Conditions that an older checkpoint does not
    record are not checked.
    """
    tensors, metadata = saved.tensors, saved.metadata
    before, recorded = config_from_dict(metadata["config"], source=str(saved.path)), metadata.get("conditions", {})
    if recorded.get("precision") == conditions.precision:  # asked for by name or by "auto", it is the same
        before = dataclasses.replace(before, precision=config.precision)
    elif config.precision != "auto" and recorded.get("precision") in ("bf16", "fp32"):
        before = dataclasses.replace(before, precision=recorded["precision"])  # what its "auto" was
    check_resume(config, before)
    _check_conditions(conditions, recorded, config.data)
    checkpoint.restore_networks(method, tensors, saved.path)
    checkpoint.restore_average(method, tensors, saved.path)
    for name, optimizer in method.optimizers.items():
        checkpoint.restore_optimizer(name, optimizer, tensors, saved.path)
    for field in dataclasses.fields(Progress):
        setattr(progress, field.name, metadata.get(field.name, getattr(progress, field.name)))
    torch.set_rng_state(checkpoint.random_state(tensors, saved.path))
    if config.device == "cuda" and "random.cuda" in tensors:
        torch.cuda.set_rng_state(tensors["random.cuda"])


def _check_conditions(now: Conditions, recorded: dict[str, object], data: Path) -> None:
    """Raise a ValueError naming what differs from the conditions that a checkpoint recorded."""
    known = [field.name for field in dataclasses.fields(now) if field.name in recorded]
    then = dataclasses.replace(now, **{name: recorded[name] for name in known})
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


def check_networks(method: Method) -> None:
    """Refuse to save networks that are no longer finite: the checkpoint on disk is better than they are."""
    for name, network in method.networks.items():
        _check_finite(f"the {name}", network.state_dict())


def _check_finite(owner: str, tensors: Mapping[str, Tensor]) -> None:
    """What is not finite would be refused when it is read again."""
    for name, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise FloatingPointError(f"{owner} has values that are not finite ({name})")
