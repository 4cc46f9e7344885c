"""Data sets in shards: the same batches and the same training as in memory, and what happens to damaged ones."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from lopsided_meshes import write_meshes
from runs import same_bits

from learn3d.data import shards
from learn3d.data.checking import check_folder
from learn3d.data.layouts import load_dataset
from learn3d.data.mirror_plane import find_mirror_plane
from learn3d.data.sampling import sample_indices
from learn3d.data.stored import StoredArray
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
    assert isinstance(after.images, StoredArray) and after.notes == ()
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
        found.append(json.loads((tmp_path / f"{name}.json").read_text()))
    assert str(found[0]).replace(str(tiny_folder), "") == str(found[1]).replace(str(stored), "")


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
    assert isinstance(few.images, StoredArray) and len(few) == 6 * n
    assert few.digest() != both.digest()


def test_a_damaged_shard_is_named_and_left_out(stored, tiny_config, tmp_path, capsys, command) -> None:
    folder = stored / "02691156" / "train"
    whole = load_dataset("kato", stored, "airplane", "train")
    images = folder / "00001.images.npy"
    images.write_bytes(images.read_bytes()[:-1000])
    part = load_dataset("kato", stored, "airplane", "train")
    assert part.num_objects == whole.num_objects - 1 and len(part) == len(whole) - 24
    (note,) = part.notes
    assert note.startswith("left out shard 1 of ") and str(images) in note
    assert part.digest() != whole.digest()
    assert train(dataclasses.replace(tiny_config(tmp_path / "run"), data=stored)).finished
    assert str(images) in capsys.readouterr().err
    status, out, _ = command("check-dataset", stored)
    assert status == 1 and str(images) in out


def test_nothing_is_measured_on_a_part_of_a_split(finished_run, stored, command) -> None:
    path = stored / "02691156" / "test" / "00000.views.npz"
    other = stored / "02691156" / "train"
    for file in other.glob("00001.*"):
        (path.parent / file.name).write_bytes(file.read_bytes())
    description = path.with_name("set.json")
    description.write_text(description.read_text().replace('"shards": 1', '"shards": 2'))
    assert command("evaluate", finished_run, "--data", stored)[0] == 0
    path.unlink()
    status, _, said = command("evaluate", finished_run, "--data", stored)
    assert status == 1 and "test is not whole: left out shard 0 of 2" in said and str(path) in said


def test_overwriting_leaves_what_is_not_a_shard(stored, tiny_folder, command) -> None:
    folder = stored / "02691156" / "train"
    (folder / "photograph.png").write_bytes(b"mine")
    (folder / "00007.images.npy").write_bytes(b"of an earlier, larger set")
    assert command("convert-dataset", "--data", tiny_folder, "--output", stored, "--overwrite")[0] == 0
    assert (folder / "photograph.png").read_bytes() == b"mine"
    assert not (folder / "00007.images.npy").exists()
    assert load_dataset("kato", stored, "airplane", "train").num_objects == 3


@pytest.mark.parametrize("name", ["00000.json", "00000.views.npz", "00000.voxels.npy"])
@pytest.mark.parametrize("content", [None, b"", b"{}", b"\x93NUMPY\x01\x00v\x00{'descr': '<f8'}"])
def test_damage_of_every_file(stored, name, content) -> None:
    path = stored / "02691156" / "train" / name
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    (note,) = load_dataset("kato", stored, "airplane", "train").notes
    assert str(path) in note


def test_changed_pixels_are_found(stored, command) -> None:
    path = stored / "02691156" / "train" / "00000.images.npy"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    status, out, _ = command("check-dataset", stored)
    assert status == 1 and f"{path}: its content is not what was written" in out


def test_a_file_that_is_cut_short_later_is_an_error(stored) -> None:
    dataset = load_dataset("kato", stored, "airplane", "train")
    path = stored / "02691156" / "train" / "00000.images.npy"
    path.write_bytes(path.read_bytes()[:200])
    dataset.prepare(torch.tensor([0, 1]))
    for _ in range(2):  # what was read ahead, and what is read now
        with pytest.raises(DamagedFile, match=r"00000\.images\.npy: cannot be read any more"):
            dataset.batch(torch.tensor([0, 1]))


def test_another_layout_or_set_file(stored) -> None:
    with pytest.raises(ValueError, match="is a data set of the layout 'kato', not 'kar'"):
        shards.load(stored, "airplane", "train", layout="kar")
    assert all(split.errors == 1 for split in check_folder("kar", stored).splits)
    assert check_folder("kato", stored).errors == 0
    path = stored / "02691156" / "train" / "set.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "shards": 0}))
    with pytest.raises(DamagedFile, match=r"set\.json: is no description of shards \(shards: "):
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
    read, original = [], StoredArray._read
    monkeypatch.setattr(
        StoredArray, "_read", lambda array, rows: (read.extend(rows.tolist()), original(array, rows))[1]
    )
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
