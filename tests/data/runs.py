"""Comparing the folders of two training runs."""

from __future__ import annotations

from pathlib import Path

import torch

from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder


def check_same(folder: Path, other: Path) -> None:
    """Weights, optimizers, random state, best networks, metrics and pictures of two runs agree to the bit."""
    for name in ("last", "best"):
        (ours, about), (theirs, about_other) = (checkpoint.load(f / f"{name}.safetensors") for f in (folder, other))
        assert ours.keys() == theirs.keys()
        assert [key for key in ours if not same_bits(ours[key], theirs[key])] == []
        for values in (about, about_other):
            del values["seconds"], values["config"]["output"]
        assert about == about_other
    assert (folder / "metrics.jsonl").read_text() == (other / "metrics.jsonl").read_text()
    pictures = [{path.name: path.read_bytes() for path in (f / "pictures").iterdir()} for f in (folder, other)]
    assert pictures[0] == pictures[1]
    earlier = [[path.name for path in run_folder.checkpoints(f)] for f in (folder, other)]
    assert earlier[0][0] == earlier[1][0] == "last.safetensors"
    assert len(earlier[0]) == len(earlier[1]) == 2
    assert not list(folder.rglob(".*")), "locks and half-written files are gone"


def same_bits(a: torch.Tensor, b: torch.Tensor) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes()
