"""Checkpoints: what they hold, and damage."""

from __future__ import annotations

import copy
import dataclasses
import errno
import json
import math
import shutil
import struct
import zlib
from pathlib import Path

import pytest
import torch
from fuzz_targets import StandIn
from reader_checks import at_most
from runs import check_same, contents, metadata, same_tensors
from safetensors.torch import save_file

from learn3d import training
from learn3d.files.reading import DamagedFile
from learn3d.runs import checkpoint
from learn3d.training import train


def test_round_trip_keeps_bits_names_and_metadata(tmp_path) -> None:
    path = tmp_path / "a.safetensors"
    tensors = {"x": torch.tensor([1.0, -0.0, 1e-40]), "y.z": torch.arange(6).reshape(2, 3).T}
    checkpoint.save(path, tensors, metadata(3, versions={"torch": "ä"}))
    loaded, about = checkpoint.load(path)
    same_tensors(loaded, tensors)
    assert about == checkpoint.load_metadata(path) == metadata(3, versions={"torch": "ä"})
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]


def test_load_method_opens_a_run_for_use(finished_run) -> None:
    random = torch.get_rng_state()
    method, config, about = checkpoint.load_method(finished_run, "last")
    assert torch.equal(torch.get_rng_state(), random)
    tensors, _ = checkpoint.load(finished_run / "last.safetensors")
    networks = {f"network.{name}": tensor for name, tensor in method.networks.state_dict().items()}
    same_tensors(networks, {name: tensors[name] for name in tensors if name in networks})
    assert not any(p.requires_grad for p in method.networks.parameters())
    assert not method.networks.training
    assert (config.category, about.progress.step) == ("airplane", 4)
    assert about.versions["torch"] == torch.__version__


def test_missing_and_foreign_files(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"there is no checkpoint .*best\.safetensors"):
        checkpoint.load_method(tmp_path, "best")
    path = tmp_path / "last.safetensors"
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(DamagedFile, match="not a checkpoint of learn3d"):
        checkpoint.load(path)
    header = b'{"x": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}'
    path.write_bytes(struct.pack("<Q", 2**60) + header)
    with at_most(2**20), pytest.raises(DamagedFile, match="is damaged or was cut short"):
        checkpoint.load(path)


def test_a_flipped_bit_in_any_byte_is_found(tmp_path) -> None:
    path = tmp_path / "last.safetensors"
    checkpoint.save(path, {"x": torch.arange(3.0), "y": torch.tensor([True])}, metadata(3))
    for position in range(path.stat().st_size):
        flip(path, position)
        with pytest.raises(DamagedFile):
            checkpoint.load(path)
        flip(path, position)
    checkpoint.load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"progress": {"step": "abc"}}, "step must be a valid integer, got 'abc'"),
        ({"progress": {"losses": {"total": "high"}}}, "losses must be a valid number"),
        ({"progress": {"surprise": 1}}, "there is no option 'surprise'"),
        ({"config": [1]}, "config must be"),
        ({"versions": None}, "versions must be"),
        ({"info": {"num_views": 10**9}}, "num_views must be less than or equal to"),
        ({"info": {}}, "num_views is missing"),
        ("[1]", "must be a mapping"),
        ("[" * 100_000, "nested too deeply"),
    ],
)
def test_metadata_of_another_form(tmp_path, change, message: str) -> None:
    values = dataclasses.asdict(metadata()) | change if isinstance(change, dict) else None
    text = change if values is None else json.dumps(values, default=str)
    header = {"learn3d": text, "crc32": f"{zlib.crc32(text.encode()):08x}"}
    save_file({}, tmp_path / "a.safetensors", metadata=header)
    for read in (checkpoint.load, checkpoint.load_metadata):
        with pytest.raises(
            ValueError, match=f"a.safetensors is no checkpoint of this version.*{message}"
        ):
            read(tmp_path / "a.safetensors")


def test_sizes_and_shapes_come_before_tensors_are_read(finished_run, tmp_path, monkeypatch) -> None:
    path = tmp_path / "a.safetensors"
    loaded, about = checkpoint.load(finished_run / "last.safetensors")
    name = next(name for name in loaded if name.startswith("network."))
    load = checkpoint.load

    def refused(message: str) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, "load", lambda *a, **o: load(*a, **o) if o else pytest.fail())
            with pytest.raises(DamagedFile, match=message):
                checkpoint.load_method(path)

    checkpoint.save(path, loaded | {name: torch.zeros(7)}, about)
    refused(rf"a.safetensors: does not fit: {name} is \(7,\), its networks need \(")
    checkpoint.save(path, {k: v for k, v in loaded.items() if k != name}, about)
    refused(f"does not fit: {name} is None, its networks need")
    monkeypatch.setattr(checkpoint.limits, "WEIGHTS_BYTES", 0)
    many = torch.zeros(1, dtype=torch.uint8).expand(6 * sum(t.numel() for t in loaded.values()))
    checkpoint.save(path, loaded | {"optimizer.more": many}, about)
    refused(r"has \d+ numbers; its networks have \d+$")
    values = dataclasses.asdict(about)
    values["config"]["settings"]["encoder"] = "conv"
    text = json.dumps(values, default=str)
    save_file({}, path, {"learn3d": text, "crc32": f"{zlib.crc32(text.encode()):08x}"})
    refused("does not fit: its networks have far more weights than it")


@pytest.mark.parametrize(
    "change",
    [{"network.encoder.0.weight": torch.zeros(3, 2)}, {"network.encoder.more": torch.zeros(1)}],
)
def test_weights_that_do_not_fit(change: dict[str, torch.Tensor]) -> None:
    tensors = checkpoint.network_tensors(StandIn()) | change
    with pytest.raises(ValueError, match=r"run\.safetensors does not fit the encoder"):
        checkpoint.restore_networks(StandIn(), tensors, Path("run.safetensors"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"0.exp_avg": torch.zeros(1)}, r"0.exp_avg is \[1\], wanted \[2, 3\]"),
        ({"0.step": torch.zeros(2)}, r"0.step is \[2\], wanted \[\]"),
        ({"7.step": torch.tensor(1.0)}, "7.step belongs to no parameter"),
        ({"-1.step": torch.tensor(1.0)}, "-1.step belongs to no parameter"),
    ],
)
def test_states_of_adam_that_do_not_fit(change: dict[str, torch.Tensor], message: str) -> None:
    """The fused kernel would read and write beyond a tensor that is too small."""
    method = StandIn()
    method.step()
    tensors = checkpoint.optimizer_tensors("encoder", method.optimizers["encoder"])
    tensors |= {f"optimizer.encoder.{key}": value for key, value in change.items()}
    with pytest.raises(ValueError, match=f"a does not fit the optimizer encoder: {message}"):
        checkpoint.restore_optimizer("encoder", method.optimizers["encoder"], tensors, Path("a"))


@pytest.mark.parametrize(
    "make",
    [
        torch.optim.Adam,
        lambda parameters: torch.optim.AdamW(parameters, fused=True, amsgrad=True),
        lambda parameters: torch.optim.SGD(parameters, lr=0.1, momentum=0.9),
        torch.optim.Adafactor,
    ],
    ids=["Adam", "fused", "SGD", "Adafactor"],
)
def test_any_optimizer_goes_on_as_if_it_had_not_been_saved(tmp_path, make) -> None:
    torch.manual_seed(0)
    images = torch.rand(2, 3, 8, 8)

    def steps(network: torch.nn.Module, optimizer: torch.optim.Optimizer) -> None:
        for _ in range(3):
            optimizer.zero_grad()
            network(images).square().sum().backward()
            optimizer.step()

    network = torch.nn.Conv2d(3, 4, 3).to(memory_format=torch.channels_last)
    other = copy.deepcopy(network)
    optimizer, resumed = make(network.parameters()), make(other.parameters())
    steps(network, optimizer)
    tensors = checkpoint.optimizer_tensors("encoder", optimizer)
    checkpoint.save(tmp_path / "a.safetensors", tensors, metadata())
    loaded, _ = checkpoint.load(tmp_path / "a.safetensors")
    other.load_state_dict(network.state_dict())
    checkpoint.restore_optimizer("encoder", resumed, loaded, tmp_path)
    steps(network, optimizer)
    steps(other, resumed)
    same_tensors(network.state_dict(), other.state_dict())


@pytest.fixture(scope="module")
def stopped(tiny_run, tmp_path_factory) -> Path:
    """The folder of a run that was stopped after four of six steps, with checkpoints of steps 4 and 2."""
    folder = tmp_path_factory.mktemp("stopped") / "run"
    train(tiny_run(folder, iterations=4))
    return folder


def test_a_run_reads_its_training_views_again(tiny_config, tmp_path) -> None:
    config = tiny_config(tmp_path, views_per_object=2)
    assert [len(checkpoint.load_data(config, split)) for split in ("train", "val")] == [3 * 2, 24]
    assert len(checkpoint.load_data(config, "train", data=config.data)) == 3 * 24


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1000])


def flip(path: Path, at: int | None = None) -> None:
    """Change a bit of a byte, of one in the last third if it does not matter of which."""
    content = bytearray(path.read_bytes())
    at = len(content) * 2 // 3 if at is None else at
    content[at] ^= 1 << at % 8
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (cut, "is damaged or was cut short"),
        (lambda path: path.write_bytes(b""), "is damaged or was cut short"),
        (lambda path: torch.save({"x": torch.zeros(1)}, path), "is damaged or was cut short"),
        (flip, "has changed since it was written (another CRC-32)"),
        (
            lambda path: save_file({"x": torch.zeros(1)}, path),
            "is a safetensors file, but not a checkpoint of learn3d",
        ),
        (Path.unlink, "going on from the checkpoint before it"),
    ],
)
def test_the_checkpoint_before_is_used(
    tiny_run, undisturbed, stopped, run_folder, capsys, damage, said: str
) -> None:
    shutil.copytree(stopped, run_folder)
    damage(run_folder / "last.safetensors")
    assert train(tiny_run(run_folder), resume=True).finished
    shown = capsys.readouterr().err
    for text in (said, "the steps since then are repeated", "resuming at step 2"):
        assert text in shown
    check_same(run_folder, undisturbed)


def test_a_checkpoint_that_cannot_be_reached_is_no_damage(
    tiny_run, stopped, run_folder, monkeypatch
) -> None:
    def away(*_, **__):
        raise OSError(errno.ESTALE, "Stale file handle")

    before = contents(shutil.copytree(stopped, run_folder))
    monkeypatch.setattr(checkpoint, "safe_open", away)
    with pytest.raises(OSError, match="Stale file handle"):
        train(tiny_run(run_folder), resume=True)
    assert contents(run_folder) == before


def test_when_none_is_whole_the_run_says_so_and_leaves_all_as_it_is(
    tiny_run, stopped, run_folder
) -> None:
    for path in shutil.copytree(stopped, run_folder).glob("*.safetensors"):
        cut(path)
    before = contents(run_folder)
    with pytest.raises(
        ValueError,
        match=r"last.safetensors: is damaged .*previous.safetensors: is .*no checkpoint is",
    ):
        train(tiny_run(run_folder), resume=True)
    assert contents(run_folder) == before


@pytest.mark.parametrize("kind", ["weights", "moments"])
def test_values_that_are_not_finite_are_not_saved(
    tiny_run, stopped, run_folder, monkeypatch, kind: str
) -> None:
    """Adam's second moment overflows long before a weight does: its square is 1e42 for a gradient of 1e21."""
    before = (shutil.copytree(stopped, run_folder) / "last.safetensors").read_bytes()
    take_step = training.take_step

    def explode(method, batch, step):
        losses, weights = take_step(method, batch, step), next(method.encoder.parameters())
        moments = method.optimizers["encoder"].state[weights]["exp_avg_sq"]
        if step == 6:
            {"weights": weights.data, "moments": moments}[kind].fill_(math.inf)
        return losses

    monkeypatch.setattr(training, "take_step", explode)
    with pytest.raises(
        FloatingPointError, match=r"encoder.* not finite.*the last good checkpoint is"
    ):
        train(tiny_run(run_folder, validate_every=100), resume=True)
    assert (run_folder / "last.safetensors").read_bytes() == before
    monkeypatch.undo()
    assert train(tiny_run(run_folder), resume=True).finished
