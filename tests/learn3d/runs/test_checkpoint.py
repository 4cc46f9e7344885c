"""Checkpoint files: what goes in comes out, and damage is said."""

from __future__ import annotations

import pytest
import torch
from runs import metadata
from safetensors.torch import save_file

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
