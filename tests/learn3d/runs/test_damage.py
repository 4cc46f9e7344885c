"""Checkpoints of a run that are cut short, changed or none at all: found, said, and replaced by the one before."""

from __future__ import annotations

import errno
import math
import shutil
from pathlib import Path

import pytest
import torch
from runs import check_same
from safetensors.torch import save_file

from learn3d.methods.pose_invariant import PoseInvariant
from learn3d.runs import checkpoint
from learn3d.training import train


@pytest.fixture(scope="module")
def stopped(tiny_run, tmp_path_factory) -> Path:
    """The folder of a run that was stopped after four of six steps, with checkpoints of steps 4 and 2."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    train(tiny_run(folder, iterations=4))
    return folder


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) * 2 // 3] ^= 16
    path.write_bytes(content)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*.safetensors")}


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (cut, "is damaged or was cut short"),
        (lambda path: path.write_bytes(b""), "is damaged or was cut short"),
        (lambda path: torch.save({"x": torch.zeros(1)}, path), "is damaged or was cut short"),
        (flip, "has changed since it was written (another CRC-32)"),
        (lambda path: save_file({"x": torch.zeros(1)}, path), "is a safetensors file, but not a checkpoint of learn3d"),
        (Path.unlink, "going on from the checkpoint before it"),
    ],
)
def test_the_checkpoint_before_is_used(tiny_run, undisturbed, stopped, run_folder, capsys, damage, said: str) -> None:
    shutil.copytree(stopped, run_folder)
    damage(run_folder / "last.safetensors")
    assert train(tiny_run(run_folder), resume=True).finished
    shown = capsys.readouterr().err
    assert all(text in shown for text in (said, "the steps since then are repeated", "resuming at step 2"))
    check_same(run_folder, undisturbed)


def test_a_checkpoint_that_cannot_be_reached_is_no_damage(tiny_run, stopped, run_folder, monkeypatch) -> None:
    def away(*_, **__):
        raise OSError(errno.ESTALE, "Stale file handle")

    before = contents(shutil.copytree(stopped, run_folder))
    monkeypatch.setattr(checkpoint, "safe_open", away)
    with pytest.raises(OSError, match="Stale file handle"):
        train(tiny_run(run_folder), resume=True)
    assert contents(run_folder) == before


def test_when_none_is_whole_the_run_says_so_and_leaves_all_as_it_is(tiny_run, stopped, run_folder) -> None:
    for path in shutil.copytree(stopped, run_folder).glob("*.safetensors"):
        cut(path)
    before = contents(run_folder)
    with pytest.raises(ValueError, match=r"last.safetensors is damaged .*previous.safetensors is .*no checkpoint is"):
        train(tiny_run(run_folder), resume=True)
    assert contents(run_folder) == before


@pytest.mark.parametrize("kind", ["weights", "moments"])
def test_values_that_are_not_finite_are_not_saved(tiny_run, stopped, run_folder, monkeypatch, kind: str) -> None:
    """Adam's second moment overflows long before a weight does: its square is 1e42 for a gradient of 1e21."""
    before = (shutil.copytree(stopped, run_folder) / "last.safetensors").read_bytes()
    real = PoseInvariant.take_step

    def explode(method, batch, step):
        losses, parameter = real(method, batch, step), next(method.encoder.parameters())
        target = parameter.data if kind == "weights" else method.optimizers["encoder"].state[parameter]["exp_avg_sq"]
        if step == 6:
            target.fill_(math.inf)
        return losses

    monkeypatch.setattr(PoseInvariant, "take_step", explode)
    with pytest.raises(FloatingPointError, match=r"encoder.* not finite.*the last good checkpoint is"):
        train(tiny_run(run_folder, validate_every=100), resume=True)
    assert (run_folder / "last.safetensors").read_bytes() == before
    monkeypatch.undo()
    assert train(tiny_run(run_folder), resume=True).finished
