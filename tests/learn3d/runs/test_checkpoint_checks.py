"""A checkpoint from a stranger: what cannot be is refused by name before anything is made of it."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
import torch
from memory_checks import at_most
from safetensors.torch import load_file, save_file

from learn3d.files import limits
from learn3d.runs import checkpoint, state


class StandIn:
    """As much of a method as a checkpoint asks for, with a step of Adam behind it."""

    def __init__(self) -> None:
        self.networks = {"encoder": torch.nn.Linear(3, 2)}
        self.optimizers = {"encoder": torch.optim.Adam(self.networks["encoder"].parameters(), fused=True)}
        self.networks["encoder"](torch.ones(1, 3)).sum().backward()
        self.optimizers["encoder"].step()

    def tensors(self) -> dict[str, torch.Tensor]:
        return checkpoint.network_tensors(self) | checkpoint.optimizer_tensors("encoder", self.optimizers["encoder"])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    tensors = StandIn().tensors() | {"random.cpu": torch.get_rng_state()}
    checkpoint.save(tmp_path / "last.safetensors", tensors, {"step": 3})
    return tmp_path / "last.safetensors"


def rewrite(path: Path, header: bytes, *, stated: int | None = None) -> None:
    """Put another header before the tensors."""
    content = path.read_bytes()
    (length,) = struct.unpack_from("<Q", content)
    path.write_bytes(struct.pack("<Q", len(header) if stated is None else stated) + header + content[8 + length :])


def header_of(path: Path) -> dict:
    content = path.read_bytes()
    return json.loads(content[8 : 8 + struct.unpack_from("<Q", content)[0]])


@pytest.mark.parametrize("stated", [2**60, 2**64 - 1, 2**31, 0, 7])
def test_headers_that_state_another_size(path, stated):
    rewrite(path, json.dumps(header_of(path)).encode(), stated=stated)
    with at_most(2**20), pytest.raises(ValueError, match=r"last\.safetensors cannot be read as a checkpoint"):
        checkpoint.load(path)


def test_files_beyond_the_limits(path, monkeypatch):
    monkeypatch.setattr(limits, "CHECKPOINT_HEADER_BYTES", 100)
    with pytest.raises(ValueError, match=r"says that its header has \d+ bytes, of \d+ in the file"):
        checkpoint.load(path)
    monkeypatch.setattr(limits, "CHECKPOINT_BYTES", 100)
    with pytest.raises(ValueError, match=r"has \d+ bytes, and at most 100 are read"):
        checkpoint.load_metadata(path)


@pytest.mark.parametrize(
    "change",
    [
        {"data_offsets": [0, 2**60]},
        {"data_offsets": [8, 0]},
        {"data_offsets": [4, 28]},
        {"shape": [2**40, 2**40]},
        {"shape": [-1, 3]},
        {"dtype": "F99"},
        {"dtype": "F64"},
    ],
)
def test_tensors_that_overlap_or_lie_outside(path, change):
    header = header_of(path)
    first = min((name for name in header if name != "__metadata__"), key=lambda name: header[name]["data_offsets"])
    header[first] |= change
    rewrite(path, json.dumps(header).encode())
    with at_most(2**20), pytest.raises(ValueError, match="cannot be read as a checkpoint"):
        checkpoint.load(path)


METADATA = {
    "iterations as a word": ({"step": "abc"}, "its step must be a number of steps, got 'abc'"),
    "negative": ({"step": -1}, "its step must be"),
    "bool": ({"best_step": True}, "its best_step must be"),
    "huge": ({"step": 10**200}, "its step must be"),
    "seconds": ({"seconds": "long"}, "its seconds must be a finite number, got 'long'"),
    "share above one": ({"object_share": 1.5}, "its object_share must be a share, 0 .. 1, got 1.5"),
    "share below none": ({"object_share": -1e-9}, "its object_share must be a share"),
    "config": ({"config": [1]}, r"its config must be a set of values by name, got \[1\]"),
    "conditions": ({"conditions": {"samples": []}}, "its conditions must be"),
    "versions": ({"versions": None}, "its versions must be"),
    "losses": ({"losses": {"total": "high"}}, "its losses must be a set of finite numbers by name"),
    "losses as a list": ({"losses": [1.0]}, "its losses must be"),
    "classes": ({"shape": {"num_views": 10**9}}, "its shape must be at most"),
    "names": ({"shape": {"num_views": 3, "other": 1}}, "its shape must be at most"),
    "first version": ({"num_views": "24"}, "its num_views must be"),
}


@pytest.mark.parametrize("name", METADATA)
def test_metadata_of_another_kind(tmp_path, name):
    change, message = METADATA[name]
    checkpoint.save(tmp_path / "a.safetensors", {}, {"step": 3} | change)
    for read in (checkpoint.load, checkpoint.load_metadata):
        with pytest.raises(ValueError, match=f"a.safetensors is no checkpoint that can be used: {message}"):
            read(tmp_path / "a.safetensors")


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"step": NaN}', "[1]", "5", "{", '{"step": 1e999}', '{"a":' * 50 + "1" + "}" * 50]
)
def test_metadata_that_are_no_plain_json(tmp_path, text):
    save_file({"x": torch.zeros(1)}, tmp_path / "a.safetensors", metadata={"learn3d": text})
    with pytest.raises(ValueError, match=r"a\.safetensors is no checkpoint that can be used"):
        checkpoint.load(tmp_path / "a.safetensors")


def test_a_checkpoint_without_a_network_is_not_used(path):
    with pytest.raises(ValueError, match="is no checkpoint of a training run: its metadata lacks config, num_views"):
        checkpoint.load_method(path)


def test_weights_of_another_type_or_not_finite(path):
    tensors, _ = checkpoint.load(path)
    fresh = StandIn()
    checkpoint.restore_networks(fresh, tensors, path)
    for value, message in (
        (torch.zeros(2, 3, dtype=torch.float64), "is torch.float64, wanted torch.float32"),
        (torch.full((2, 3), float("nan")), "has values that are not finite"),
        (torch.zeros(3, 2), "size mismatch"),
    ):
        with pytest.raises(ValueError, match=rf"(?s)does not fit the encoder: .*{message}"):
            checkpoint.restore_networks(fresh, tensors | {"network.encoder.weight": value}, path)


MOMENTS = {
    "another shape": ({"optimizer.encoder.0.exp_avg": torch.zeros(1)}, r"torch.float32 \[1\], wanted .* \[2, 3\]"),
    "another type": ({"optimizer.encoder.0.exp_avg": torch.zeros(2, 3).half()}, "is torch.float16"),
    "not finite": ({"optimizer.encoder.0.exp_avg_sq": torch.full((2, 3), float("inf"))}, "not finite"),
    "many steps": ({"optimizer.encoder.0.step": torch.zeros(2)}, r"torch.float32 \[2\], wanted torch.float32 \[\]"),
    "no parameter": ({"optimizer.encoder.7.step": torch.tensor(1.0)}, "belongs to none of the 2 parameters"),
    "no number": ({"optimizer.encoder.x.step": torch.tensor(1.0)}, "belongs to none of the 2 parameters"),
    "negative": ({"optimizer.encoder.-1.step": torch.tensor(1.0)}, "belongs to none of the 2 parameters"),
    "unknown field": ({"optimizer.encoder.0.momentum": torch.zeros(2, 3)}, "is nothing that Adam keeps"),
    "half a state": ({"optimizer.encoder.0.step": None}, "optimizer.encoder.0 lacks some of step"),
}


@pytest.mark.parametrize("name", MOMENTS)
def test_states_of_adam_that_do_not_go_with_the_parameters(path, name):
    """The fused kernel would read and write beyond a tensor that is too small."""
    change, message = MOMENTS[name]
    tensors = {key: value for key, value in (load_file(path) | change).items() if value is not None}
    fresh = StandIn()
    with pytest.raises(ValueError, match=f"the checkpoint does not fit the optimizer encoder: .*{message}"):
        checkpoint.restore_optimizer("encoder", fresh.optimizers["encoder"], tensors)
    checkpoint.restore_optimizer("encoder", fresh.optimizers["encoder"], load_file(path))


@pytest.mark.parametrize(
    "state", [None, torch.zeros(5, dtype=torch.uint8), torch.zeros(5056), torch.full((5056,), 255, dtype=torch.uint8)]
)
def test_states_of_the_random_numbers(path, state):
    tensors = {key: value for key, value in (load_file(path) | {"random.cpu": state}).items() if value is not None}
    with pytest.raises(ValueError, match=r"last\.safetensors holds (no|a) state of the random numbers"):
        checkpoint.random_state(tensors, path)
    assert torch.equal(checkpoint.random_state(load_file(path), path), load_file(path)["random.cpu"])


def test_losses_may_be_as_large_as_those_that_a_run_goes_on_with(tmp_path):
    losses = {"smoothness": float(torch.finfo(torch.float32).max), "total": 1e41}
    checkpoint.save(tmp_path / "a.safetensors", {}, {"step": 3, "losses": losses})
    assert checkpoint.load_metadata(tmp_path / "a.safetensors")["losses"] == losses


def test_conditions_of_another_version_are_passed_over(tmp_path):
    now = state.Conditions(72, "0a", "fp32")
    state._check_conditions(now, {"samples": 72, "surprise": 5}, tmp_path)
    with pytest.raises(ValueError, match="cannot resume with other training data: many images in the run, 72 in"):
        state._check_conditions(now, {"samples": "many"}, tmp_path)
