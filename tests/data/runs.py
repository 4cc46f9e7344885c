"""Disturbing training runs, and comparing the folders of two."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from learn3d import training
from learn3d.config import TrainConfig
from learn3d.data.dataset import Batch, DatasetInfo
from learn3d.methods.method import Method
from learn3d.presets import configure
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.runs.checkpoint import Metadata, Progress
from learn3d.training import train


def check_same(folder: Path, other: Path) -> None:
    """Weights, optimizers, random state, best networks, metrics and pictures of two runs agree to the bit."""
    for name in ("last", "best"):
        (ours, about), (theirs, about_other) = (
            checkpoint.load(f / f"{name}.safetensors") for f in (folder, other)
        )
        same_tensors(ours, theirs)
        described = []
        for values in map(dataclasses.asdict, (about, about_other)):
            del values["progress"]["seconds"], values["config"]["output"]
            described.append(values)
        differ = [name for name, value in described[0].items() if value != described[1][name]]
        assert not differ, [tuple(each[key] for each in described) for key in differ]
    assert (folder / "metrics.jsonl").read_text() == (other / "metrics.jsonl").read_text()
    pictures = [
        {path.name: path.read_bytes() for path in (f / "pictures").iterdir()}
        for f in (folder, other)
    ]
    assert pictures[0] == pictures[1]
    assert len(run_folder.checkpoints(folder)) == len(run_folder.checkpoints(other)) == 2
    assert not list(folder.rglob(".*")), "locks and half-written files are gone"


def metadata(step: int = 3, **changes: Any) -> Metadata:
    """The metadata of a checkpoint."""
    config = configure(data="data", category="chair", output="run")
    about = Metadata(
        config, DatasetInfo(24, inverted=False), Progress(step=step), "72 images", {"torch": "2"}
    )
    return dataclasses.replace(about, **changes)


def contents(folder: Path, pattern: str = "**/*") -> dict[str, bytes]:
    """The files of a folder."""
    files = (path for path in sorted(folder.glob(pattern)) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def same_tensors(ours: dict[str, torch.Tensor], theirs: dict[str, torch.Tensor]) -> None:
    """Two checkpoints have the same tensors, to the bit."""
    assert ours.keys() == theirs.keys()
    assert [name for name in ours if not same_bits(ours[name], theirs[name])] == []


def same_bits(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes()


def stop_and_resume(config: TrainConfig, step: int) -> None:
    """A run that a signal stops after a step, and that then goes on to its end."""
    with pytest.MonkeyPatch.context() as patch:
        before_step(patch, step, lambda: signal.raise_signal(signal.SIGTERM))
        assert train(config).progress.step == step
    torch.manual_seed(99)
    assert train(config, resume=True).finished


def before_step(patch: pytest.MonkeyPatch, step: int, action: Callable[[], object]) -> None:
    """Let something happen before a training step, once."""
    take_step, left = training.take_step, [action]

    def act_and_step(method: Method, batch: Batch, now: int) -> dict[str, float]:
        if now == step and left:
            left.pop()()
        return take_step(method, batch, now)

    patch.setattr(training, "take_step", act_and_step)
