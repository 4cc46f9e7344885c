"""Checkpoint files: what goes in comes out, and damage is said."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from learn3d import checkpoint
from learn3d.networks import PoseDiscriminator, create_networks


def test_round_trip_keeps_bits_names_and_metadata(tmp_path) -> None:
    path = tmp_path / "a.safetensors"
    tensors = {"x": torch.tensor([1.0, -0.0, 1e-40]), "y.z": torch.arange(6).reshape(2, 3).T}
    checkpoint.save(path, tensors, {"step": 3, "config": {"name": "ä"}})
    loaded, metadata = checkpoint.load(path)
    assert loaded.keys() == tensors.keys()
    assert all(torch.equal(loaded[key], tensors[key]) for key in tensors)
    assert metadata["step"] == 3
    assert metadata["config"] == {"name": "ä"}
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_a_failed_save_leaves_the_old_file(tmp_path, monkeypatch) -> None:
    path = tmp_path / "a.safetensors"
    checkpoint.save(path, {"x": torch.zeros(1)}, {"step": 1})

    def fail(tensors, file, metadata):
        file.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(checkpoint, "save_file", fail)
    with pytest.raises(OSError, match="disk full"):
        checkpoint.save(path, {"x": torch.ones(1)}, {"step": 2})
    assert checkpoint.load(path)[1]["step"] == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_a_file_that_cannot_be_written_is_an_oserror(tmp_path) -> None:
    path = tmp_path / "nowhere" / "a.safetensors"
    with pytest.raises(OSError, match=r"cannot write the checkpoint .*a\.safetensors"):
        checkpoint.save(path, {"x": torch.zeros(1)}, {"step": 1})


@pytest.mark.parametrize("keep", [0, 4, 60, -1])
def test_truncated_file(tmp_path, keep: int) -> None:
    path = tmp_path / "last.safetensors"
    checkpoint.save(path, {"x": torch.zeros(100)}, {"step": 1})
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ValueError, match="damaged or was cut short"):
        checkpoint.load(path)


def test_missing_foreign_and_future_files(tmp_path) -> None:
    with pytest.raises(ValueError, match="there is no checkpoint"):
        checkpoint.load(checkpoint.find(tmp_path))
    save_file({"x": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    with pytest.raises(ValueError, match="not a checkpoint of learn3d"):
        checkpoint.load(tmp_path / "foreign.safetensors")
    checkpoint.save(tmp_path / "future.safetensors", {}, {"format": 99})
    with pytest.raises(ValueError, match="checkpoint format 99"):
        checkpoint.load(tmp_path / "future.safetensors")


def test_networks_of_another_shape_are_refused(tmp_path) -> None:
    networks = create_networks(24, discriminator=True, device="cpu", seed=0)
    tensors = checkpoint.network_tensors(networks)
    networks.discriminator = PoseDiscriminator(72)
    with pytest.raises(ValueError, match="does not fit the discriminator"):
        checkpoint.restore_networks(networks, tensors, tmp_path)


def test_load_networks_gives_the_saved_ones_for_use(finished_run) -> None:
    random = torch.get_rng_state()
    networks, config, metadata = checkpoint.load_networks(checkpoint.find(finished_run, "last"))
    assert torch.equal(torch.get_rng_state(), random)
    tensors, _ = checkpoint.load(finished_run / "last.safetensors")
    assert torch.equal(networks.encoder.layers[0].weight, tensors["network.encoder.layers.0.weight"])
    assert networks.discriminator.layers[-1].out_features == 24
    assert not any(p.requires_grad for _, network in networks.items() for p in network.parameters())
    assert (config.category, metadata["step"]) == ("airplane", 4)
