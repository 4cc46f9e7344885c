"""Checkpoint files: what goes in comes out, and damage is said."""

from __future__ import annotations

import pytest
import torch
from runs import metadata
from safetensors.torch import save_file

from learn3d.methods import DatasetInfo, create_method
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint


def test_round_trip_keeps_bits_names_and_metadata(tmp_path) -> None:
    path = tmp_path / "a.safetensors"
    tensors = {"x": torch.tensor([1.0, -0.0, 1e-40]), "y.z": torch.arange(6).reshape(2, 3).T}
    checkpoint.save(path, tensors, metadata(3, versions={"torch": "ä"}))
    loaded, about = checkpoint.load(path)
    assert loaded.keys() == tensors.keys()
    assert all(torch.equal(loaded[key], tensors[key]) for key in tensors)
    assert about == metadata(3, versions={"torch": "ä"})
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch) -> None:
    path = tmp_path / "a.safetensors"
    checkpoint.save(path, {"x": torch.zeros(1)}, metadata(1))

    def fail(tensors, file, metadata):
        file.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(checkpoint, "save_file", fail)
    with pytest.raises(OSError, match=r"cannot write the checkpoint .*a\.safetensors: disk full"):
        checkpoint.save(path, {"x": torch.ones(1)}, metadata(2))
    assert checkpoint.load(path)[1].progress.step == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_a_file_that_cannot_be_written_is_an_oserror(tmp_path) -> None:
    path = tmp_path / "nowhere" / "a.safetensors"
    with pytest.raises(OSError, match=r"cannot write the checkpoint .*a\.safetensors"):
        checkpoint.save(path, {"x": torch.zeros(1)}, metadata(1))


@pytest.mark.parametrize("keep", [0, 4, 60, -1])
def test_truncated_file(tmp_path, keep: int) -> None:
    path = tmp_path / "last.safetensors"
    checkpoint.save(path, {"x": torch.zeros(100)}, metadata(1))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match="damaged or was cut short"):
        checkpoint.load(path)


def test_missing_foreign_and_future_files(tmp_path, monkeypatch) -> None:
    with pytest.raises(ValueError, match="there is no checkpoint"):
        checkpoint.load(checkpoint.find(tmp_path))
    save_file({"x": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    with pytest.raises(ValueError, match="not a checkpoint of learn3d"):
        checkpoint.load(tmp_path / "foreign.safetensors")
    monkeypatch.setattr(checkpoint, "FORMAT", 99)
    checkpoint.save(tmp_path / "future.safetensors", {"x": torch.zeros(1)}, metadata())
    monkeypatch.undo()
    with pytest.raises(ValueError, match="checkpoint format 99"):
        checkpoint.load(tmp_path / "future.safetensors")


def test_networks_of_another_shape_are_refused(tmp_path) -> None:
    of_24_views, of_72_views = (
        create_method(PRESETS["peng2020-kato"].settings, DatasetInfo(k), device="cpu", precision="fp32", seed=0)
        for k in (24, 72)
    )
    with pytest.raises(ValueError, match="does not fit the discriminator"):
        checkpoint.restore_networks(of_72_views, checkpoint.network_tensors(of_24_views), tmp_path)


def test_load_method_gives_the_saved_one_for_use(finished_run) -> None:
    random = torch.get_rng_state()
    method, config, about = checkpoint.load_method(checkpoint.find(finished_run, "last"))
    networks = method.networks
    assert torch.equal(torch.get_rng_state(), random)
    tensors, _ = checkpoint.load(finished_run / "last.safetensors")
    assert torch.equal(networks["encoder"].layers[0].weight, tensors["network.encoder.layers.0.weight"])
    assert networks["discriminator"].layers[-1].out_features == 24
    assert not any(p.requires_grad for network in networks.values() for p in network.parameters())
    assert not method.training
    assert (config.category, about.progress.step) == ("airplane", 4)
    assert about.versions["torch"] == torch.__version__
