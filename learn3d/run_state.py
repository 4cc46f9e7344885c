"""The state of a run on disk: its folder, what is saved to continue it bit for bit, and under which conditions."""

from __future__ import annotations

import dataclasses
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path

import torch

from learn3d import checkpoint, checkpoint_checks
from learn3d.config import TrainConfig, check_resume, config_from_dict
from learn3d.methods import DataShape, Method
from learn3d.versions import versions

CONFIG_FILE = "config.json"


@dataclass
class Progress:
    """Where a run stands."""

    step: int = 0  # steps taken
    best_iou: float = -1.0  # best validation IoU so far, see `validate`; -1 before the first validation
    best_step: int = 0
    seconds: float = 0.0  # spent in training, over all resumptions
    object_share: float = 0.0  # side of the objects' bounding squares over that of the pictures, training mean


@dataclass(frozen=True)
class Conditions:
    """What decides the next steps besides the options and the saved state; a resumed run must find it as it was."""

    samples: int  # training images: their number decides the order
    images: str  # CRC-32 of the training images, as stored
    precision: str  # bf16 or fp32: what "auto" came to


def claim_folder(folder: Path, overwrite: bool) -> None:
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


def save_last(
    folder: Path,
    config: TrainConfig,
    conditions: Conditions,
    method: Method,
    shape: DataShape,
    progress: Progress,
) -> None:
    """Write last.safetensors: networks, optimizers, random state, progress, configuration, conditions and versions."""
    check_networks(method, folder)
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
    checkpoint_checks.require(metadata, ("config", "step"), path)
    saved, recorded = config_from_dict(metadata["config"], source=str(path)), metadata.get("conditions", {})
    if recorded.get("precision") == conditions.precision:  # asked for by name or by "auto", it is the same
        saved = dataclasses.replace(saved, precision=config.precision)
    check_resume(config, saved)
    _check_conditions(conditions, recorded, config.data)
    checkpoint.restore_networks(method, tensors, path)
    for name, optimizer in method.optimizers.items():
        checkpoint.restore_optimizer(name, optimizer, tensors, path)
    for field in dataclasses.fields(Progress):
        setattr(progress, field.name, metadata.get(field.name, getattr(progress, field.name)))
    torch.set_rng_state(checkpoint.random_state(tensors, path))
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


def check_networks(method: Method, folder: Path) -> None:
    """Refuse to save networks that are no longer finite: the checkpoint on disk is better than they are."""
    for name, network in method.networks.items():
        if not all(bool(parameter.isfinite().all()) for parameter in network.parameters()):
            raise FloatingPointError(f"the {name} has weights that are not finite; {last_good(folder)}")


def last_good(folder: Path) -> str:
    path = folder / "last.safetensors"
    if not path.is_file():
        return "there is no checkpoint yet; try a lower learning_rate or precision fp32"
    return f"the last good checkpoint is {path}; try a lower learning_rate or precision fp32"


def resume_command(folder: Path) -> str:
    """The command line that continues the run in `folder`, quoted for a POSIX shell."""
    return f"python tools/train.py --output {shlex.quote(str(folder))} --resume"
