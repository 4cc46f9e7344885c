"""A checkpoint from a stranger: what cannot be is refused by name before anything is made of it."""

from __future__ import annotations

import dataclasses
import json
import struct
import zlib
from pathlib import Path

import pytest
import torch
from memory_checks import at_most
from runs import metadata
from safetensors.torch import load_file, save_file

from learn3d.files import limits
from learn3d.runs import checkpoint


class StandIn:
    """As much of a method as a checkpoint asks for, with a step of Adam behind it."""

    def __init__(self) -> None:
        self.networks = {"encoder": torch.nn.Linear(3, 2)}
        self.optimizers = {"encoder": torch.optim.Adam(self.networks["encoder"].parameters(), fused=True)}
        self.networks["encoder"](torch.ones(1, 3)).sum().backward()
        self.optimizers["encoder"].step()

    def tensors(self) -> dict[str, torch.Tensor]:
        return checkpoint.network_tensors(self) | checkpoint.optimizer_state("encoder", self.optimizers["encoder"])[0]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    checkpoint.save(tmp_path / "last.safetensors", StandIn().tensors(), metadata(3))
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
    "a word": ({"progress": {"step": "abc"}}, "step must be a whole number, got 'abc'"),
    "negative": ({"progress": {"step": -1}}, "step must be at least 0"),
    "losses": ({"progress": {"losses": {"total": "high"}}}, "losses must be a number"),
    "unknown": ({"progress": {"surprise": 1}}, "there is no option 'surprise'"),
    "config": ({"config": [1]}, "config .* must hold options by name"),
    "fingerprint": ({"fingerprint": {"samples": []}}, "samples must be"),
    "versions": ({"versions": None}, "versions must be"),
    "classes": ({"info": {"num_views": 10**9}}, "num_views must be at most"),
    "missing": ({"info": {}}, "num_views is missing"),
}


def write_header(path: Path, values: object) -> None:
    text = values if isinstance(values, str) else json.dumps(values, default=str)
    header = {"learn3d": text, "metadata_crc32": f"{zlib.crc32(text.encode()):08x}"}
    save_file({"x": torch.zeros(1)}, path, metadata=header)


@pytest.mark.parametrize("name", METADATA)
def test_metadata_of_another_kind(tmp_path, name):
    change, message = METADATA[name]
    write_header(tmp_path / "a.safetensors", dataclasses.asdict(metadata()) | {"format": checkpoint.FORMAT} | change)
    with pytest.raises(checkpoint.DamagedError, match=f"a.safetensors is no checkpoint that can be used: .*{message}"):
        checkpoint.load_metadata(tmp_path / "a.safetensors")


@pytest.mark.parametrize(
    "text", ["[" * 100_000, '{"step": NaN}', "[1]", "5", "{", '{"step": 1e999}', '{"a":' * 50 + "1" + "}" * 50]
)
def test_metadata_that_are_no_plain_json(tmp_path, text):
    write_header(tmp_path / "a.safetensors", text)
    with pytest.raises(ValueError, match=r"a\.safetensors (is no|has) checkpoint"):
        checkpoint.load_metadata(tmp_path / "a.safetensors")


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
    "negative": ({"optimizer.encoder.-1.step": torch.tensor(1.0)}, "belongs to none of the 2 parameters"),
    "half a state": ({"optimizer.encoder.0.step": None}, "other entries"),
}


@pytest.mark.parametrize("name", MOMENTS)
def test_states_of_adam_that_do_not_go_with_the_parameters(path, name):
    """The fused kernel would read and write beyond a tensor that is too small."""
    change, message = MOMENTS[name]
    tensors = {key: value for key, value in (load_file(path) | change).items() if value is not None}
    fresh = StandIn()
    with pytest.raises(ValueError, match=f"the checkpoint does not fit the optimizer encoder: .*{message}"):
        checkpoint.restore_optimizer("encoder", fresh.optimizers["encoder"], tensors, {})
    checkpoint.restore_optimizer("encoder", fresh.optimizers["encoder"], load_file(path), {})


OPTIMIZERS = {
    "Adam": torch.optim.Adam,
    "fused": lambda parameters: torch.optim.AdamW(parameters, fused=True, amsgrad=True),
    "SGD": lambda parameters: torch.optim.SGD(parameters, lr=0.1, momentum=0.9),
    "Adafactor": torch.optim.Adafactor,
    "ASGD": torch.optim.ASGD,
}


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_any_optimizer_goes_on_as_if_it_had_not_been_saved(tmp_path, name):
    torch.manual_seed(0)
    network = torch.nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
    images = torch.rand(2, 3, 8, 8)

    def steps(network: torch.nn.Module, optimizer: torch.optim.Optimizer) -> list[torch.Tensor]:
        for _ in range(3):
            optimizer.zero_grad()
            network(images).square().sum().backward()
            optimizer.step()
        return [p.detach().clone() for p in network.parameters()]

    optimizer = OPTIMIZERS[name](network.parameters())
    steps(network, optimizer)
    state, others = checkpoint.optimizer_state("encoder", optimizer)
    tensors = state | {f"network.{key}": value for key, value in network.state_dict().items()}
    checkpoint.save(tmp_path / "a.safetensors", tensors, metadata(optimizers={"encoder": others}))
    loaded, about = checkpoint.load(tmp_path / "a.safetensors")
    other = torch.nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
    other.load_state_dict(checkpoint.starting_with("network.", loaded))
    resumed = OPTIMIZERS[name](other.parameters())
    checkpoint.restore_optimizer("encoder", resumed, loaded, about.optimizers["encoder"])
    assert all(torch.equal(a, b) for a, b in zip(steps(network, optimizer), steps(other, resumed), strict=True))
