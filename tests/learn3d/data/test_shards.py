"""Data sets in shards: the same batches and the same training as in memory, and what happens to damaged ones."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from lopsided_meshes import write_meshes
from runs import same_bits
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from learn3d.data import shards
from learn3d.data.checking import check_folder
from learn3d.data.disk_array import DiskArray
from learn3d.data.layouts import load_dataset
from learn3d.data.mirror_plane import find_mirror_plane
from learn3d.data.sampling import sample_indices
from learn3d.files.findings import DamagedFile
from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.runs import checkpoint
from learn3d.training import train

SPLITS = {
    "kato": {"test": 1, "val": 0},
    "dvr": {"test": 1, "val": 0},
    "kar": {"test": 1, "val": 0, "views": 4},
    "r2n2": {},
    "pascal3d": {"val": 1, "views": 4},
    "photos": {"test": 1, "val": 0, "views": 4},
}


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    return write_meshes(tmp_path_factory.mktemp("meshes"))


@pytest.fixture
def small_shards(monkeypatch):
    """One object in each shard."""
    monkeypatch.setattr(shards, "SHARD_BYTES", 1)


@pytest.mark.parametrize("layout", SPLITS)
def test_every_layout_keeps_its_batches(layout, meshes, tmp_path, command, small_shards) -> None:
    config = DatasetConfig(output=tmp_path / "data", category="chair", source=meshes, layout=layout, **SPLITS[layout])
    make_dataset(config, progress=False)
    status, out, said = command(
        "convert-dataset", "--data", tmp_path / "data", "--layout", layout, "--output", tmp_path / "shards"
    )
    assert status == 0 and "train: " in out, said
    before = load_dataset(layout, tmp_path / "data", "chair", "train")
    before = before.select(np.argsort(before.object_ids, kind="stable"))  # as they come in shards of one object
    after = load_dataset(layout, tmp_path / "shards", "chair", "train")
    assert isinstance(after.images, DiskArray) and after.notes == ()
    for name in ("view_names", "object_names", "convention", "inverted", "num_views", "pose_features", "image_size"):
        assert getattr(after, name) == getattr(before, name), name
    order = torch.randperm(len(before))
    one, other = before.batch(order), after.batch(order)
    for name in ("images", "masks", "view_ids", "object_ids", "class_ids", "voxels"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None and b is None) or torch.equal(a, b), name
    assert torch.equal(one.poses.features(), other.poses.features())
    assert after.object_share() == pytest.approx(before.object_share())
    assert after.check_masks() == before.check_masks()
    if layout not in ("pascal3d", "photos"):
        assert find_mirror_plane(after) == find_mirror_plane(before)


def test_pascal3d_by_either_name_and_split(meshes, tmp_path, command, small_shards) -> None:
    given = {"category": "airplane", "source": meshes, "layout": "pascal3d"} | SPLITS["pascal3d"]
    make_dataset(DatasetConfig(output=tmp_path / "data", **given), progress=False)
    words = ("--data", tmp_path / "data", "--layout", "pascal3d", "--category", "airplane")
    assert command("convert-dataset", *words, "--output", tmp_path / "shards")[0] == 0
    val, test = (load_dataset("pascal3d", tmp_path / "shards", "aeroplane", split) for split in ("val", "test"))
    assert val.digest() == test.digest()


def same_networks(folder, other) -> None:
    """Weights, optimizers and random state of two runs agree to the bit."""
    (ours, _), (theirs, _) = (checkpoint.load(f / "last.safetensors") for f in (folder, other))
    assert ours.keys() == theirs.keys()
    assert [key for key in ours if not same_bits(ours[key], theirs[key])] == []


@pytest.fixture
def stored(tiny_folder, tmp_path, command, small_shards):
    """The tiny data set in shards."""
    assert command("convert-dataset", "--data", tiny_folder, "--output", tmp_path / "shards")[0] == 0
    return tmp_path / "shards"


@pytest.mark.parametrize("options", [{}, {"preset": "plus-kato", "augment": ("colors",), "views_per_object": 3}])
def test_training_has_the_same_bits(options, tiny_config, stored, tmp_path) -> None:
    config = tiny_config(tmp_path / "memory", **options)
    assert train(config).finished
    assert train(dataclasses.replace(config, data=stored, output=tmp_path / "disk")).finished
    same_networks(tmp_path / "memory", tmp_path / "disk")


def test_a_run_is_measured_alike(finished_run, stored, tiny_folder, command, tmp_path) -> None:
    found = []
    for name, folder in {"memory": tiny_folder, "disk": stored}.items():
        words = ("--data", folder, "--json", tmp_path / f"{name}.json")
        assert command("evaluate", finished_run, *words)[0] == 0
        text = (tmp_path / f"{name}.json").read_text()
        found.append(text.replace(str(tiny_folder), "DATA").replace(str(stored), "DATA"))
    assert found[0] == found[1]


def test_a_stopped_run_goes_on(tiny_config, stored, tmp_path) -> None:
    whole = dataclasses.replace(tiny_config(tmp_path / "whole"), data=stored)
    train(whole)
    train(dataclasses.replace(whole, output=tmp_path / "part", iterations=2))
    train(dataclasses.replace(whole, output=tmp_path / "part"), resume=True)
    same_networks(tmp_path / "whole", tmp_path / "part")


def test_pairs_and_classes_are_drawn_from_shards(stored, tiny_folder) -> None:
    for sampling in ("views", "pairs", "classes"):
        sets = [load_dataset("kato", folder, "airplane", "train") for folder in (tiny_folder, stored)]
        one, other = (sample_indices(each, sampling, 8, 3, 5) for each in sets)
        assert torch.equal(one, other)


def test_no_rows_are_an_empty_array(stored) -> None:
    images = load_dataset("kato", stored, "airplane", "train").images
    assert images[np.empty(0, np.int64)].shape == (0, 4, 64, 64)


def test_overwriting_with_what_is_not_there_keeps_the_shards(stored, command, tmp_path, tiny_folder) -> None:
    before = sorted(stored.rglob("*"))
    (tmp_path / "nothing").mkdir()
    words = ("--output", stored, "--category", "airplane", "--overwrite")
    assert command("convert-dataset", "--data", tmp_path / "nothing", *words)[0] == 1
    assert sorted(stored.rglob("*")) == before


def test_only_shards_are_removed(stored, command, tiny_folder) -> None:
    folder = stored / "02691156" / "train"
    (folder / "2024-notes.json").write_text("mine")
    assert command("convert-dataset", "--data", tiny_folder, "--output", stored, "--overwrite")[0] == 0
    assert (folder / "2024-notes.json").read_text() == "mine"


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


def flip_byte(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


def test_a_damaged_shard_is_named_and_left_out(stored, tiny_config, tmp_path, capsys, command) -> None:
    whole = load_dataset("kato", stored, "airplane", "train")
    path = shard_file(stored, 1)
    path.write_bytes(path.read_bytes()[:-1000])
    part = load_dataset("kato", stored, "airplane", "train")
    assert part.num_objects == whole.num_objects - 1 and len(part) == len(whole) - 24
    (note,) = part.notes
    assert note.startswith("left out one of 3 shards: ") and str(path) in note
    assert part.digest() != whole.digest()
    assert train(dataclasses.replace(tiny_config(tmp_path / "run"), data=stored)).finished
    assert str(path) in capsys.readouterr().err
    status, out, _ = command("check-dataset", stored)
    assert status == 1 and str(path) in out


def test_nothing_is_measured_on_a_part_of_a_split(finished_run, stored, command) -> None:
    path = shard_file(stored, split="test")
    shard_file(stored, 1, "test").write_bytes(shard_file(stored, 1).read_bytes())
    description = path.with_name("set.json")
    description.write_text(description.read_text().replace('"shards": 1', '"shards": 2'))
    assert command("evaluate", finished_run, "--data", stored)[0] == 0
    path.unlink()
    status, _, said = command("evaluate", finished_run, "--data", stored)
    assert status == 1 and f"test is not whole: left out 1 of 2 shards, which are missing: {path}" in said


def test_overwriting_leaves_what_is_not_a_shard(stored, tiny_folder, command) -> None:
    folder = stored / "02691156" / "train"
    (folder / "photograph.png").write_bytes(b"mine")
    (folder / "00007.safetensors").write_bytes(b"of an earlier, larger set")
    assert command("convert-dataset", "--data", tiny_folder, "--output", stored, "--overwrite")[0] == 0
    assert (folder / "photograph.png").read_bytes() == b"mine"
    assert not (folder / "00007.safetensors").exists()
    assert load_dataset("kato", stored, "airplane", "train").num_objects == 3


def test_any_tool_that_knows_safetensors_opens_a_shard(stored, tiny_set) -> None:
    tensors = load_file(shard_file(stored, 1))
    np.testing.assert_array_equal(tensors["images"], tiny_set.images[24:48])
    assert tensors["images.checksums"][5] == zlib.crc32(tiny_set.images[29])


@pytest.mark.parametrize("content", [None, b"", b"{}", b"\xff" * 50, b"\x02\0\0\0\0\0\0\0{}"])
def test_a_file_that_is_no_shard_is_named(stored, content) -> None:
    path = shard_file(stored)
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    (note,) = load_dataset("kato", stored, "airplane", "train").notes
    assert str(path) in note


def rewrite(stored: Path, **changes) -> Path:
    """Shard 0 with other tensors and correct checksums; None leaves one out."""
    path = shard_file(stored)
    with safe_open(path, "np") as file:
        metadata = json.loads(file.metadata()["shard"])
    arrays = {name: value for name, value in (load_file(path) | changes).items() if value is not None}
    for name in {"images", "voxels"} & changes.keys():
        arrays[f"{name}.checksums"] = np.array([zlib.crc32(row) for row in changes[name]], np.uint32)
    tables = {name: arrays[name] for name in arrays if name not in ("images", "voxels")}
    metadata["crc"] = shards._crc(metadata["objects"], tables)
    save_file(arrays, path, {"shard": json.dumps(metadata)})
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"azimuth_deg": np.full(24, np.nan, np.float32)}, "the pose of view 0 is out of range"),
        ({"sides": np.full(24, 2, np.float32)}, r"sides must lie in 0 .. 1"),
        ({"view_ids": np.full(24, 24, np.int32)}, r"view_ids must lie in 0 .. 23"),
        ({"object_ids": np.full(24, -1, np.int32)}, r"object_ids must lie in 0 .. 0"),
        ({"sides": None}, "it has no sides"),
        ({"azimuth_deg": np.zeros(23, np.float32)}, r"azimuth_deg is F32 [23]; expected F32 [24]"),
        ({"images": np.zeros((24, 4, 32, 32), np.uint8)}, r"images is U8 [24, 4, 32, 32]; expected U8 [24, 4, 64, 64]"),
        ({"other": np.zeros(24, np.float32)}, "KeyError: 'other'"),
    ],
)
def test_tables_that_cannot_be_are_refused(stored, changes, message) -> None:
    path = rewrite(stored, **changes)
    (note,) = load_dataset("kato", stored, "airplane", "train").notes
    assert str(path) in note and message in note


def test_bools_other_than_0_and_1_are_refused(stored) -> None:
    path = rewrite(stored, voxels=np.full((1, 32, 32, 32), 7, np.uint8).view(np.bool_))
    with pytest.raises(DamagedFile, match=f"{path}: .*its bools have values other than 0 and 1"):
        load_dataset("kato", stored, "airplane", "train").batch(torch.tensor([0]))


def test_a_changed_pixel_is_not_trained_on(stored, tiny_config, tmp_path, command) -> None:
    path = shard_file(stored)
    flip_byte(path, path.read_bytes().index(load_file(path)["images"].tobytes()) + 9)
    with pytest.raises(DamagedFile, match=f"{path}: cannot be used any more .* another CRC-32"):
        train(dataclasses.replace(tiny_config(tmp_path / "run", iterations=18), data=stored))
    status, out, _ = command("check-dataset", stored)
    assert status == 1 and f"{path}: cannot be used" in out


def test_a_changed_table_is_left_out(stored) -> None:
    path = shard_file(stored)
    flip_byte(path, path.read_bytes().index(load_file(path)["azimuth_deg"].tobytes()) + 9)
    (note,) = load_dataset("kato", stored, "airplane", "train").notes
    assert note.startswith(f"left out one of 3 shards: {path}") and "another CRC-32" in note


def test_a_shard_that_changed_after_a_kill_is_noticed(stored, tiny_config, tmp_path) -> None:
    """With the old checksums by the first batch, with new ones before it."""
    config = dataclasses.replace(tiny_config(tmp_path / "run"), data=stored)
    train(dataclasses.replace(config, iterations=2))
    other = 255 - load_file(shard_file(stored))["images"]
    rewrite(stored, images=other)
    with pytest.raises(ValueError, match="other training data"):
        train(config, resume=True)


def test_pipes_and_devices_are_refused_at_once(stored) -> None:
    for number, make in enumerate((os.mkfifo, lambda path: os.symlink("/dev/zero", path))):
        shard_file(stored, number).unlink()
        make(shard_file(stored, number))
    notes = load_dataset("kato", stored, "airplane", "train").notes
    assert len(notes) == 2 and all("it is no plain file" in note for note in notes)


def test_a_set_that_claims_a_million_shards_is_one_note(stored) -> None:
    path = stored / "02691156" / "train" / "set.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "shards": 10**6}))
    began = time.process_time()
    (note,) = load_dataset("kato", stored, "airplane", "train").notes
    assert note.startswith(f"left out 999997 of 1000000 shards, which are missing: {shard_file(stored, 3)}")
    assert time.process_time() - began < 2


def test_a_file_that_is_cut_short_later_is_an_error(stored) -> None:
    dataset = load_dataset("kato", stored, "airplane", "train")
    path = shard_file(stored)
    path.write_bytes(path.read_bytes()[:200])
    dataset.prepare(torch.tensor([0, 1]))
    for _ in range(2):  # rows that were read ahead, and rows that are read now
        with pytest.raises(DamagedFile, match=r"00000\.safetensors: cannot be used any more \(it ends early\)"):
            dataset.batch(torch.tensor([0, 1]))


def test_another_layout_or_set_file(stored) -> None:
    with pytest.raises(ValueError, match="is a data set of the layout 'kato', not 'kar'"):
        shards.load(stored, "airplane", "train", layout="kar")
    assert all(split.errors == 1 for split in check_folder("kar", stored).splits)
    assert check_folder("kato", stored).errors == 0
    path = stored / "02691156" / "train" / "set.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "shards": 0}))
    with pytest.raises(DamagedFile, match=r"set\.json: is no description of shards \(shards must "):
        load_dataset("kato", stored, "airplane", "train")


def test_what_is_read_ahead_is_what_was_asked_for(stored) -> None:
    dataset = load_dataset("kato", stored, "airplane", "train")
    first, second = torch.tensor([3, 1]), torch.tensor([2, 2])
    images = [dataset.batch(indices).images for indices in (first, second)]
    dataset.prepare(first)
    assert torch.equal(dataset.batch(second).images, images[1]), "another batch than was expected"
    assert torch.equal(dataset.batch(first).images, images[0])
    with pytest.raises(TypeError, match="by their numbers"):
        dataset.images[:, 3]


def test_each_of_several_processes_reads_its_own_rows(stored, tiny_folder, monkeypatch) -> None:
    dataset, indices = load_dataset("kato", stored, "airplane", "train"), torch.tensor([5, 60, 33, 2, 41])
    whole = load_dataset("kato", tiny_folder, "airplane", "train").batch(indices)
    read, original = [], DiskArray._read
    monkeypatch.setattr(DiskArray, "_read", lambda array, rows: (read.extend(rows.tolist()), original(array, rows))[1])
    for rank, rows in enumerate((torch.tensor([0, 1, 2]), torch.tensor([3, 4]))):
        dataset.prepare(indices, rows)
        part = dataset.batch(indices, rows, voxels=False)
        assert torch.equal(part.images, whole.images[rows])
        assert torch.equal(part.step_views.view_ids, whole.view_ids)
        assert read == indices[rows].tolist(), f"once, by process {rank}"
        read.clear()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is measured on Linux only")
def test_memory_does_not_grow_with_the_data(tmp_path) -> None:
    """200 MB of images, of which batches are read, take a few megabytes."""
    code = """
import resource, sys, numpy as np, torch
from pathlib import Path
from learn3d.data import shards
from learn3d.data.layouts import load_dataset
from learn3d.data.readers import kato
folder = Path(sys.argv[1])
if len(sys.argv) == 3:
    rng = np.random.default_rng(0)
    where = shards.split_folder(folder, "chair", "train")
    for number in range(4):
        images = np.full((128, 24, 4, 64, 64), 128 + number, np.uint8)
        part = kato.from_arrays(images, np.zeros((128, 32, 32, 32), bool), "chair", "train")
        shards.write_shard(where, number, part)
    shards.finish_set(where, "kato", 4, part)
else:
    load_dataset("kato", folder, "chair", "train")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    dataset = load_dataset("kato", folder, "chair", "train")
    for step in range(100):
        batch = dataset.batch(torch.randint(len(dataset), (128,)))
        assert (batch.images.min(), batch.images.max()) == (128, 131)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    for words in (["make"], []):
        done = subprocess.run(
            [sys.executable, "-c", code, tmp_path, *words], capture_output=True, text=True, cwd=tmp_path
        )
        assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 60_000, f"{done.stdout} kB more"
