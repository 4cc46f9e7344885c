"""Data sets in shards: the same batches and the same training as in memory; damaged shards are refused."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import stub_work
import torch
from reader_checks import problems
from runs import same_tensors
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from learn3d import tasks
from learn3d.data import shards
from learn3d.data.conventions import SET_FILE, shards_folder
from learn3d.data.disk_array import DiskArray
from learn3d.data.layouts import check_folder, load_dataset
from learn3d.data.readers import kato
from learn3d.files.reading import DamagedFile
from learn3d.runs import checkpoint
from learn3d.training import train


@pytest.fixture
def small_shards(monkeypatch):
    """One object in each shard, converted in this process."""
    monkeypatch.setattr(shards, "SHARD_BYTES", 1)
    monkeypatch.setattr(tasks, "run_tasks", stub_work.run_tasks_here)


def same_networks(folder, other) -> None:
    """Weights, optimizers and random state of two runs agree to the bit."""
    same_tensors(*(checkpoint.load(f / "last.safetensors")[0] for f in (folder, other)))


@pytest.fixture
def stored(tiny_folder, tmp_path, command, small_shards):
    """The tiny data set in shards."""
    output = tmp_path / "shards"
    assert command("convert-dataset", "--data", tiny_folder, "--output", output)[0] == 0
    return output


@pytest.mark.parametrize(
    "options", [{}, {"preset": "plus-kato", "augment": ("colors",), "views_per_object": 3}]
)
def test_training_has_the_same_bits(options, tiny_config, stored, tmp_path) -> None:
    config = tiny_config(tmp_path / "memory", **options)
    assert train(config).finished
    assert train(dataclasses.replace(config, data=stored, output=tmp_path / "disk")).finished
    same_networks(tmp_path / "memory", tmp_path / "disk")
    (tmp_path / "new").touch()
    modes = {path.stat().st_mode for path in tmp_path.rglob("*.safetensors")}
    assert modes == {(tmp_path / "new").stat().st_mode}, (
        "others may read shards and checkpoints as the umask says"
    )


def test_several_categories(stored, tiny_folder, tmp_path) -> None:
    (stored / "02691156").rename(stored / "a")
    for name in ("b", "c"):
        (stored / name).symlink_to(stored / "a")
    both = load_dataset("kato", stored, "b,a,c", "train")
    alone = load_dataset("kato", stored, "a", "train")
    m, n = len(alone), alone.num_objects
    assert (both.num_classes, len(both), both.num_objects) == (3, 3 * m, 3 * n)
    batch = both.batch(torch.tensor([0, m, 2 * m + 1]))
    assert torch.equal(batch.images[:2], alone.batch(torch.tensor([0, 0])).images)
    assert torch.equal(batch.images[2], alone.batch(torch.tensor([1])).images[0])
    assert batch.class_ids.tolist() == [0, 1, 2] and batch.object_ids.tolist() == [0, n, 2 * n]
    few = both.with_few_views(2)
    assert isinstance(few.images, DiskArray) and len(few) == 6 * n
    assert few.digest() != both.digest()


def shard_file(stored: Path, number: int = 0, split: str = "train") -> Path:
    return shards.shard_path(stored / "02691156" / split, number)


def set_file(stored: Path) -> Path:
    return stored / "02691156" / "train" / SET_FILE


def change_set_file(stored: Path, **changes: int) -> None:
    """With the right checksum."""
    facts = json.loads(set_file(stored).read_text()) | changes | {"crc": None}
    crc = zlib.crc32(json.dumps(facts, sort_keys=True).encode())
    set_file(stored).write_text(json.dumps(facts | {"crc": crc}))


@pytest.mark.parametrize("name", ["elevation_deg", "distance", "half_fov_deg"])
def test_cameras_have_a_checksum_and_older_shards_are_read_and_said(stored, name, capsys) -> None:
    facts = json.loads(set_file(stored).read_text())
    facts["constants"][name] *= 1.01
    set_file(stored).write_text(json.dumps(facts))
    expect(stored, set_file(stored), "its content has changed since it was written")
    del facts["crc"]
    facts["constants"][name] /= 1.01
    set_file(stored).write_text(json.dumps(facts))
    assert load_dataset("kato", stored, "airplane", "train").num_objects == 3
    assert "set.json: has no checksum of its cameras" in capsys.readouterr().err
    (found,) = problems("kato", stored, "train", "airplane")
    assert found.severity == "warning" and "has no checksum of its cameras" in found.message


def flip_bit(path: Path, name: str) -> None:
    """Change a tensor of a shard."""
    content = bytearray(path.read_bytes())
    content[content.index(load_file(path)[name].tobytes()) + 9] ^= 1
    path.write_bytes(content)


def test_any_tool_that_knows_safetensors_opens_a_shard(stored, tiny_set) -> None:
    tensors = load_file(shard_file(stored, 1))
    np.testing.assert_array_equal(tensors["images"], tiny_set.images[24:48])
    assert tensors["images.checksums"][5] == zlib.crc32(tiny_set.images[29])


def expect(stored: Path, path: Path, message: str) -> None:
    """Training and the check must name the shard and say the message."""
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        load_dataset("kato", stored, "airplane", "train")
    assert str(error.value).startswith(f"{path}: ") and message in str(error.value)
    found = problems("kato", stored, "train", "airplane")
    assert [(p.path, message in p.message) for p in found] == [(str(path), True)]


def test_shards_that_are_missing_or_too_many_are_refused(stored, tiny_folder, command) -> None:
    path = shard_file(stored, 1)
    path.rename(other := shard_file(stored, 7))
    other.rename(other.with_name("mine.safetensors"))
    expect(stored, path, "is missing: the split has 3 shards, and 2 files")
    shard_file(stored, 1).write_bytes(shard_file(stored).read_bytes())
    other.write_bytes(b"of an earlier, larger set")
    with pytest.raises(
        ValueError,
        match=r"00007\.safetensors: is not one of them: the split has 3 shards, and 4 files",
    ):
        load_dataset("kato", stored, "airplane", "train")
    (mine := other.with_name("photograph.png")).write_bytes(b"mine")
    set_file(stored).unlink()  # as an unfinished conversion leaves it
    for name in (".00001.safetensors.a-1.partial", ".tmpA1b2c3"):
        mine.with_name(name).touch()
    assert command("convert-dataset", "--data", tiny_folder, "--output", stored)[0] == 0
    assert mine.read_bytes() == b"mine" and not other.exists(), "only shards are removed"
    assert not list(mine.parent.glob(".*")), "and half-written files"
    assert load_dataset("kato", stored, "airplane", "train").num_objects == 3


@pytest.mark.parametrize("content", [b"", b"{}", b"\xff" * 50, b"\x02\0\0\0\0\0\0\0{}"])
def test_a_file_that_is_no_shard_is_named(stored, content) -> None:
    shard_file(stored).write_bytes(content)
    expect(stored, shard_file(stored), "cannot be read as a shard of a data set")


def rewrite(stored: Path, **changes) -> Path:
    """Shard 0 with other tensors and correct checksums; None leaves one out."""
    path = shard_file(stored)
    with safe_open(path, "np") as file:
        metadata = json.loads(file.metadata()["shard"])
    arrays = {name: a for name, a in (load_file(path) | changes).items() if a is not None}
    for name in {"images", "voxels"} & changes.keys() & arrays.keys():
        arrays[f"{name}.checksums"] = np.uint32([zlib.crc32(row) for row in changes[name]])
    tables = {name: arrays[name] for name in arrays if name not in ("images", "voxels")}
    metadata["crc"] = shards._crc(metadata["objects"], tables)
    save_file(arrays, path, {"shard": json.dumps(metadata)})
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"azimuth_deg": np.full(24, np.nan, np.float32)}, "the pose of view 0 is out of range"),
        ({"sides": np.full(24, 2, np.float32)}, "sides must lie in 0 .. 1"),
        ({"view_ids": np.full(24, 24, np.int32)}, r"view_ids must lie in 0 .. 23"),
        ({"object_ids": np.full(24, -1, np.int32)}, r"object_ids must lie in 0 .. 0"),
        ({"sides": None}, "KeyError: 'sides'"),
        (
            {"azimuth_deg": np.zeros(23, np.float32)},
            "poses of 24 images of 1 objects must be [24], got [23]",
        ),
        ({"images": np.zeros((24, 4, 32, 32), np.uint8)}, "images of 32 pixels need masks of 64"),
        ({"view_ids": np.zeros(24, np.float32)}, "view_ids is float32; expected int32"),
    ],
)
def test_impossible_tables_are_refused(stored, changes, message) -> None:
    expect(stored, rewrite(stored, **changes), message)


def test_shards_of_other_arrays_are_refused(stored) -> None:
    rewrite(stored, voxels=None, **{"voxels.checksums": None})
    expect(stored, shard_file(stored).parent, "has shards that differ (voxels of different kinds")


def test_bools_other_than_0_and_1_are_refused(stored) -> None:
    path = rewrite(stored, voxels=np.full((1, 32, 32, 32), 7, np.uint8).view(np.bool_))
    with pytest.raises(DamagedFile, match=f"{path}: .*its bools have values other than 0 and 1"):
        load_dataset("kato", stored, "airplane", "train").batch(torch.tensor([0]))


def test_points_that_are_not_finite_are_refused(tiny_set, tmp_path) -> None:
    points = np.full((tiny_set.num_objects, 2, 3), np.nan, np.float32)
    folder = shards.shards_folder(tmp_path, "airplane", "test")
    shards.write_set(folder, "kato", dataclasses.replace(tiny_set, points=points))
    found = load_dataset("kato", tmp_path, "airplane", "test").points
    with pytest.raises(DamagedFile, match="it has numbers that are not finite"):
        found[np.array([0])]


def test_a_changed_pixel_is_not_trained_on(stored, tiny_config, tmp_path, command) -> None:
    path = shard_file(stored)
    flip_bit(path, "images")
    with pytest.raises(DamagedFile, match=f"{path}: cannot be used any more .* another CRC-32"):
        train(dataclasses.replace(tiny_config(tmp_path / "run", iterations=18), data=stored))
    status, out, _ = command("check-dataset", stored)
    assert status == 1 and f"{path}: cannot be used" in out


def test_a_changed_table_is_refused(stored) -> None:
    path = shard_file(stored)
    flip_bit(path, "azimuth_deg")
    expect(stored, path, "another CRC-32")
    flip_bit(path, "azimuth_deg")
    content = path.read_bytes()
    assert content.count(b'[\\"0000\\"]') == 1
    path.write_bytes(content.replace(b'[\\"0000\\"]', b'[\\"0001\\"]'))
    expect(stored, path, "another CRC-32")


def test_a_shard_that_changed_after_a_kill_is_noticed(stored, tiny_config, tmp_path) -> None:
    """With the old checksums by the first batch, with new ones before it."""
    config = dataclasses.replace(tiny_config(tmp_path / "run"), data=stored)
    train(dataclasses.replace(config, iterations=2))
    other = 255 - load_file(shard_file(stored))["images"]
    rewrite(stored, images=other)
    with pytest.raises(ValueError, match="other training data"):
        train(config, resume=True)


def test_a_set_that_claims_a_million_shards_is_refused_at_once(stored) -> None:
    change_set_file(stored, shards=10**6)
    began = time.process_time()
    expect(stored, shard_file(stored, 3), "is missing: the split has 1000000 shards, and 3 files")
    assert time.process_time() - began < 2


def test_a_file_that_is_cut_short_later_is_an_error(stored) -> None:
    dataset = load_dataset("kato", stored, "airplane", "train")
    path = shard_file(stored)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(
        DamagedFile, match=r"0\.safetensors: cannot be used any more \(it ends early"
    ):
        dataset.batch(torch.tensor([0, 1]))


def test_another_layout_or_set_file(stored) -> None:
    with pytest.raises(ValueError, match="in the layout 'kato', expected 64 pixels in 'kar'"):
        shards.load(stored, "airplane", "train", layout="kar")
    with pytest.raises(ValueError, match=r"expected 224 pixels in 'kato'; .* another --image-size"):
        shards.load(stored, "airplane", "train", layout="kato", image_size=224)
    assert all(split.count("error") == 1 for split in check_folder("kar", stored))
    assert sum(split.count("error") for split in check_folder("kato", stored)) == 0
    change_set_file(stored, shards=0)
    with pytest.raises(DamagedFile, match=r"set\.json: is no description of shards \(shards must "):
        load_dataset("kato", stored, "airplane", "train")


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured on Linux only")
def test_memory_does_not_grow_with_the_data(tmp_path) -> None:
    """200 MB of images, of which batches are read, take a few megabytes."""
    where = shards_folder(tmp_path, "chair", "train")
    for number in range(4):
        images = np.full((128, 24, 4, 64, 64), 128 + number, np.uint8)
        part = kato.from_arrays(images, np.zeros((128, 32, 32, 32), bool), "chair", "train")
        shards.write_shard(where, number, part)
    shards.finish_set(where, "kato", 4, part)
    code = """
import resource, sys, torch
from learn3d.data.layouts import load_dataset
load_dataset("kato", sys.argv[1], "chair", "train")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
dataset = load_dataset("kato", sys.argv[1], "chair", "train")
for step in range(100):
    batch = dataset.batch(torch.randint(len(dataset), (128,)))
    assert (batch.images.min(), batch.images.max()) == (128, 131)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 60_000, f"{done.stdout} kB more"
