"""Comparing the folders of two training runs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from learn3d.data.dataset import DatasetInfo
from learn3d.presets import configure
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.runs.checkpoint import Metadata, Progress


def check_same(folder: Path, other: Path) -> None:
    """Weights, optimizers, random state, best networks, metrics and pictures of two runs agree to the bit."""
    for name in ("last", "best"):
        (ours, about), (theirs, about_other) = (
            checkpoint.load(f / f"{name}.safetensors") for f in (folder, other)
        )
        assert ours.keys() == theirs.keys()
        assert [key for key in ours if not same_bits(ours[key], theirs[key])] == []
        described = []
        for values in map(dataclasses.asdict, (about, about_other)):
            del values["progress"]["seconds"], values["config"]["output"]
            described.append(values)
        assert described[0] == described[1]
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


def same_bits(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes()
