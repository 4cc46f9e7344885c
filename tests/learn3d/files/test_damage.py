"""Checkpoints that are cut short, changed or none at all: found, said, and replaced by the one before."""

from __future__ import annotations

import errno
import math
import shutil
from pathlib import Path

import pytest
import torch
from runs import check_same, metadata
from safetensors.torch import save_file

from learn3d.methods.pose_invariant import PoseInvariant
from learn3d.runs import checkpoint, state
from learn3d.runs import folder as run_folder
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


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (cut, "is damaged or was cut short"),
        (lambda path: path.write_bytes(b""), "is damaged or was cut short"),
        (lambda path: torch.save({"x": torch.zeros(1)}, path), "is damaged or was cut short"),
        (flip, "has changed since it was written (CRC-32 "),
        (lambda path: save_file({"x": torch.zeros(1)}, path), "is a safetensors file, but not a checkpoint of learn3d"),
        (Path.unlink, "going on from the checkpoint before it"),
    ],
)
def test_the_checkpoint_before_is_used(tiny_run, undisturbed, stopped, run_folder, capsys, damage, said: str) -> None:
    shutil.copytree(stopped, run_folder)
    last = run_folder / "last.safetensors"
    damage(last)
    broken = last.read_bytes() if last.exists() else None
    assert train(tiny_run(run_folder), resume=True).finished
    shown = capsys.readouterr().err
    journal = (run_folder / "journal.txt").read_text()
    for text in (said, "step-000002.safetensors; the steps since then are repeated", "resuming at step 2"):
        assert text in shown
        assert text in journal
    if broken is not None:
        assert (run_folder / "damaged.safetensors").read_bytes() == broken
        (run_folder / "damaged.safetensors").unlink()
    check_same(run_folder, undisturbed)


def test_a_checkpoint_that_cannot_be_reached_is_no_damage(tiny_run, stopped, run_folder, monkeypatch) -> None:
    shutil.copytree(stopped, run_folder)
    before = {path.name: path.read_bytes() for path in run_folder.rglob("*.safetensors")}

    def away(*_, **__):
        raise OSError(errno.ESTALE, "Stale file handle")

    monkeypatch.setattr(checkpoint, "safe_open", away)
    with pytest.raises(OSError, match="Stale file handle"):
        train(tiny_run(run_folder), resume=True)
    assert {path.name: path.read_bytes() for path in run_folder.rglob("*.safetensors")} == before


def test_only_the_first_process_repairs(tiny_run, stopped, run_folder) -> None:
    shutil.copytree(stopped, run_folder)
    cut(run_folder / "last.safetensors")
    names = sorted(path.name for path in run_folder.rglob("*"))
    with pytest.raises(checkpoint.DamagedError, match="is damaged or was cut short"):
        state.load_last(tiny_run(run_folder), repair=False)
    assert sorted(path.name for path in run_folder.rglob("*")) == names
    (run_folder / "last.safetensors").unlink()
    assert state.load_last(tiny_run(run_folder), repair=False).metadata.progress.step == 2
    assert not (run_folder / "last.safetensors").exists()


def test_what_could_not_be_resumed_is_not_saved(tiny_run, stopped, run_folder, monkeypatch) -> None:
    """Adam's second moment overflows long before a weight does: its square is 1e42 for a gradient of 1e21."""
    shutil.copytree(stopped, run_folder)
    before = (run_folder / "last.safetensors").read_bytes()
    real = PoseInvariant.take_step

    def explode(method, batch, step):
        losses = real(method, batch, step)
        method.optimizers["encoder"].state[next(method.encoder.parameters())]["exp_avg_sq"].fill_(math.inf)
        return losses

    monkeypatch.setattr(PoseInvariant, "take_step", explode)
    with pytest.raises(
        FloatingPointError, match="the optimizer of the encoder has values that are not finite"
    ) as error:
        train(tiny_run(run_folder), resume=True)
    assert "the last good checkpoint is" in str(error.value)
    assert (run_folder / "last.safetensors").read_bytes() == before
    monkeypatch.undo()
    assert train(tiny_run(run_folder), resume=True).finished


def test_when_none_is_whole_the_run_says_so_and_leaves_all_as_it_is(tiny_run, stopped, run_folder) -> None:
    shutil.copytree(stopped, run_folder)
    for path in run_folder.glob("**/*.safetensors"):
        cut(path)
    before = {path: path.read_bytes() for path in run_folder.rglob("*.safetensors")}
    with pytest.raises(ValueError, match=r"last.safetensors cannot .*step-000002.safetensors cannot .*no checkpoint"):
        train(tiny_run(run_folder), resume=True)
    assert {path: path.read_bytes() for path in run_folder.rglob("*.safetensors")} == before


def test_a_checkpoint_of_a_later_version_is_no_damage(tiny_run, stopped, run_folder, monkeypatch) -> None:
    shutil.copytree(stopped, run_folder)
    tensors, metadata = checkpoint.load(run_folder / "last.safetensors")
    monkeypatch.setattr(checkpoint, "FORMAT", 99)
    checkpoint.save(run_folder / "last.safetensors", tensors, metadata)
    monkeypatch.undo()
    with pytest.raises(ValueError, match="checkpoint format 99"):
        train(tiny_run(run_folder), resume=True)


def test_a_flipped_bit_in_any_byte_is_found(tmp_path) -> None:
    path = tmp_path / "last.safetensors"
    checkpoint.save(path, {"x": torch.arange(3.0), "y": torch.tensor([True])}, metadata(3))
    content = path.read_bytes()
    path.write_bytes(content.replace(b'\\"step\\": 3', b'\\"step\\": 2'))
    with pytest.raises(checkpoint.DamagedError, match="has changed since it was written"):
        checkpoint.load_metadata(path)  # the header alone is checked, too
    for position in range(len(content)):
        bit = 1 << position % 8
        path.write_bytes(content[:position] + bytes([content[position] ^ bit]) + content[position + 1 :])
        with pytest.raises(checkpoint.DamagedError):
            checkpoint.load(path)


def test_kept_checkpoints_can_be_used_by_name(stopped) -> None:
    method, _, metadata = checkpoint.load_method(run_folder.checkpoints(stopped)[1])
    assert metadata.progress.step == 2
    assert method.networks["encoder"] is not None
