"""Meshes -> a data set: formats, frames, splits, colours, determinism, kept and replaced files, errors."""

from __future__ import annotations

import json
import shutil
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from lopsided_meshes import make

import nmr
from learn3d.commands import main
from learn3d.data.conventions import mesh_to_object, view_cameras
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import kato
from learn3d.make_data import meshes, render
from learn3d.make_data.render import DatasetConfig, make_dataset, split_objects
from learn3d.make_data.report import missing_split_warnings
from learn3d.make_data.writers import WRITERS


@pytest.fixture
def folder(tmp_path) -> Path:
    """Six small meshes, one per file format (two PLY), of different size and place."""
    path = tmp_path / "meshes"
    (path / "more").mkdir(parents=True)
    for i, suffix in enumerate(("obj", "off", "ply", "stl", "glb")):
        box = trimesh.creation.box((1.0 + i, 2.0, 0.5))
        box.apply_translation((10.0 * i, -3.0, 5.0))
        box.export(path / f"box{i}.{suffix}")
    trimesh.creation.torus(1.0, 0.3).export(path / "more" / "torus.PLY", file_type="ply")
    return path


def load(folder: Path, split: str = "train") -> tuple[ViewDataset, np.ndarray]:
    """The chairs as their reader has them, and their images by object, uint8 [N, 24, 4, 64, 64]."""
    dataset = kato.load(folder, "chair", split)
    return dataset, dataset.images.reshape(-1, 24, 4, 64, 64)


def placed(path: Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices in the object frame and faces."""
    mesh = trimesh.load(path, force="mesh", process=False)
    vertices = meshes.fit_to_box(mesh.vertices @ mesh_to_object().T)
    return torch.tensor(vertices, dtype=torch.float32), torch.tensor(np.asarray(mesh.faces))


def test_every_format_round_trips_through_the_reader(tmp_path, folder):
    report = make(tmp_path / "data", folder)
    assert report.objects == {"train": 6} and not report.skipped and all(mesh["watertight"] for mesh in report.used)
    dataset, images = load(tmp_path / "data")
    names = json.loads((tmp_path / "data" / "03001627_card.json").read_text())["splits"]["train"]
    assert sorted(names) == ["box0.obj", "box1.off", "box2.ply", "box3.stl", "box4.glb", "more/torus.PLY"]
    for number, name in enumerate(names):
        vertices, faces = placed(folder / name)
        assert torch.equal(dataset.voxelize(vertices, faces)[0], torch.from_numpy(dataset.voxels[number])), name
        alpha = nmr.render_silhouette(vertices, faces, view_cameras(torch.arange(24)), image_size=64)
        np.testing.assert_array_equal(images[number, :, 3], np.rint(255 * alpha.numpy()), err_msg=name)
    brightest, alpha = images[:, :, :3].max(axis=2), images[:, :, 3]  # colours are stored inverted
    assert (brightest[alpha == 0] == 0).all() and (brightest[alpha == 255] > 0).all()
    said = (tmp_path / "data" / "03001627_report.txt").read_text()
    assert "6 meshes used, 0 skipped" in said and "03001627_contact.png: rows: up to 6 objects of each split" in said


@pytest.mark.parametrize(("up", "front"), [("y", None), ("z", None), ("x", "-z")])
def test_asymmetry_appears_on_the_side_where_a_viewer_sees_it(tmp_path, up, front):
    """A post stands at front-left of a slab, left as seen by somebody in front (who looks along -front).

    A viewer's right is (looking direction) x up in the right-handed frame of mesh files. View 0 looks from the front;
    view 6 looks from the side that the viewer of view 0 has on the left. So the post, at the corner between the two, is
    left in view 0, right in view 6 (from there the front is on the right), right from behind (12) and left in 18.
    """
    axes = {"x": np.eye(3)[0], "y": np.eye(3)[1], "z": np.eye(3)[2], "-z": -np.eye(3)[2]}
    u, f = axes[up], axes[front or "x"]
    right = np.cross(-f, u)
    slab, post = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))
    slab.vertices = slab.vertices @ np.stack([1.0 * f, 0.1 * u, 1.0 * right])
    post.vertices = post.vertices @ np.stack([0.1 * f, 0.6 * u, 0.1 * right]) + 0.4 * f + 0.3 * u - 0.4 * right
    (tmp_path / "in").mkdir()
    trimesh.util.concatenate([slab, post]).export(tmp_path / "in" / "post.ply")
    make(tmp_path / "data", tmp_path / "in", up=up, front=front)
    dataset, images = load(tmp_path / "data")
    for view, side in ((0, "left"), (6, "right"), (12, "right"), (18, "left")):
        alpha = images[0, view, 3].astype(float)
        rows = np.nonzero(alpha.any(axis=1))[0]
        top = alpha[rows[0] : rows[0] + 4].sum(axis=0)  # row 0 is the top: the head of the post is up there
        column = (top * np.arange(64)).sum() / top.sum()
        assert (column < 28) if side == "left" else (column > 36), (view, side, column)
    # voxel axes (y, x, -z) of the object frame: up, right as seen from the front, towards the front
    top = np.argwhere(dataset.voxels[0][16:].any(axis=0)).mean(axis=0)
    assert top[0] < 8 and top[1] > 24


def test_our_own_mistakes_are_not_taken_for_bad_meshes_and_leave_nothing_behind(tmp_path, folder, monkeypatch):
    for error in (IndexError, KeyboardInterrupt):

        def fail(*_, error=error, **__):
            raise error("a slip in the renderer")

        monkeypatch.setattr(render, "photograph", fail)
        with pytest.raises(error, match="a slip in the renderer"):
            make(tmp_path / "data", folder)
        assert list((tmp_path / "data").iterdir()) == []


def test_only_training_objects_get_scaled_copies(tmp_path, folder):
    report = make(tmp_path / "data", folder, test=2, val=1, augment=2)
    assert report.objects == {"train": 9, "val": 1, "test": 2}
    dataset, _ = load(tmp_path / "data")
    name = json.loads((tmp_path / "data" / "03001627_card.json").read_text())["splits"]["train"][0]
    own = dataset.voxelize(*placed(folder / name))[0].numpy()
    np.testing.assert_array_equal(dataset.voxels[0], own)
    assert not np.array_equal(dataset.voxels[1], own) and not np.array_equal(dataset.voxels[1], dataset.voxels[2])
    for voxels in dataset.voxels:  # every copy fills the box again
        spans = [np.ptp(np.nonzero(voxels.any(axis=other))[0]) + 1 for other in ((1, 2), (0, 2), (0, 1))]
        assert max(spans) >= 31


def test_split_is_test_then_val_then_train_of_one_permutation():
    order = np.random.default_rng(0).permutation(116)
    splits = split_objects(116, 0.2, 0.0, 0)
    np.testing.assert_array_equal(splits["test"], order[:23])  # max(4, round(0.2 * 116))
    np.testing.assert_array_equal(splits["train"], order[23:])
    assert len(splits["val"]) == 0
    assert len(split_objects(10, 0.2, 0.0, 0)["test"]) == 4  # at least four
    splits = split_objects(50, 7, 0.1, 5)
    assert [len(splits[s]) for s in ("test", "val", "train")] == [7, 5, 38]
    np.testing.assert_array_equal(np.concatenate(list(splits.values())), np.random.default_rng(5).permutation(50))
    for count in range(1, 40):
        small = split_objects(count, 0.2, 0.1, 0)  # the defaults leave something to train on
        assert len(small["train"]) >= max(1, count // 3)
        assert min(len(small["test"]), len(small["val"])) >= min(4, count // 3)
    for bad in ((-1, 0), (2.5, 0), (8, 4), (6, 4), (float("nan"), 0)):
        with pytest.raises(ValueError, match=r"share|leave none of the 10 meshes to train on"):
            split_objects(10, *bad, 0)


def test_colours_of_the_mesh_or_random_ones(tmp_path):
    (tmp_path / "in").mkdir()
    box = trimesh.creation.box((1, 1, 1))
    box.visual.face_colors = np.tile([255, 0, 0, 255], (12, 1))
    box.export(tmp_path / "in" / "red.ply")
    for color in ("mesh", "random"):
        make(tmp_path / color, tmp_path / "in", color=color)
        image = load(tmp_path / color)[1][0]
        inside = image[:, :3].transpose(0, 2, 3, 1)[image[:, 3] == 255]  # inverted: red is (0, 255, 255) at full light
        red = (inside[:, 1] == 255) & (inside[:, 2] == 255) & (inside[:, 0] < 255)
        assert red.all() if color == "mesh" else not red.any()
        assert len(np.unique(inside[:, 0])) >= 3  # faces differ in light
    make(tmp_path / "seed1", tmp_path / "in", seed=1)
    a, b = (load(tmp_path / name)[1] for name in ("random", "seed1"))
    assert np.array_equal(a[:, :, 3], b[:, :, 3]) and not np.array_equal(a, b)


def test_files_of_a_category_are_replaced_only_when_asked(tmp_path, folder):
    make(tmp_path / "data", folder, test=2)
    with pytest.raises(FileExistsError, match="--overwrite"):
        make(tmp_path / "data", folder)
    make(tmp_path / "data", folder, category="table")  # another category may live in the same folder
    make(tmp_path / "data", folder, overwrite=True)
    left = sorted(path.name for path in (tmp_path / "data").glob("*.npz"))
    assert left == [
        f"{synset}_train_{kind}.npz" for synset in ("03001627", "04379243") for kind in ("images", "voxels")
    ]


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"source": "nowhere"}, FileNotFoundError, "no folder or mesh pack"),
        ({"source": "meshes/box0.obj"}, ValueError, "folder of meshes or a mesh pack"),
        ({"source": "nothing"}, ValueError, "no mesh file"),
        ({"source": "bad"}, ValueError, r"none of the 1 meshes .* a.obj: no faces"),
        ({"procedural": 3}, ValueError, "either --source"),
        ({"source": None}, ValueError, "either --source"),
        ({"source": None, "procedural": 3, "category": "unicorn"}, ValueError, "procedural generator makes"),
        ({"augment": -1}, ValueError, "augment must be at least 0"),
        ({"color": "blue"}, ValueError, "color"),
        ({"up": "z", "front": "-z"}, ValueError, "two different axes"),
        ({"out": "bad/a.obj"}, OSError, "cannot write"),
        ({"layout": "coco"}, ValueError, "layout must be .*kato"),
        ({"layout": "kato", "views": 12}, ValueError, "24 views"),
        ({"layout": "kar", "views": 0}, ValueError, "views must be at least 1"),
        ({"layout": "r2n2", "val": 1, "test": None}, ValueError, "no val split"),
        ({"layout": "r2n2", "augment": 2, "test": None}, ValueError, "first 80 %"),
        ({"layout": "r2n2", "test": 0.5}, ValueError, "first 80 %"),
        ({"layout": "pascal3d", "test": 0.2}, ValueError, "no test split"),
        ({"source": "single", "layout": "pascal3d", "views": 1, "test": None}, ValueError, "two pictures"),
        ({"source": "single", "layout": "r2n2", "views": 1, "test": None}, ValueError, "two objects"),
    ],
)
def test_settings_and_folders_that_are_refused(tmp_path, folder, settings, error, message):
    for name in ("nothing", "bad", "single"):
        (tmp_path / name).mkdir()
    (tmp_path / "bad" / "a.obj").write_text("v 0 0 0\n")
    shutil.copy(folder / "box0.obj", tmp_path / "single")
    settings = {"out": "data", "source": "meshes", **settings}
    out, source = tmp_path / settings.pop("out"), settings.pop("source")
    with pytest.raises(error, match=message):
        make(out, None if source is None else tmp_path / source, **settings)
    assert not out.is_dir() or not list(out.iterdir())


def test_a_full_disk_is_refused_before_the_work(tmp_path, folder, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(2**30, 2**30, 1000))
    with pytest.raises(OSError, match="MiB free"):
        make(tmp_path / "data", folder)


def test_a_data_set_without_training_objects_is_not_made(tmp_path, folder):
    sources, _ = meshes.folder_sources(folder)
    for number in split_objects(6, 2, 2, seed=0)["train"]:
        (folder / sources[number].name).write_text("damaged")
    with pytest.raises(ValueError, match="none of the 2 meshes to train on can be used"):
        make(tmp_path / "data", folder, test=2, val=2)
    assert list((tmp_path / "data").iterdir()) == []


@pytest.mark.parametrize(
    ("layout", "objects", "said"),
    [
        ("kato", {"train": 2}, "no val and no test split: training cannot be validated"),
        ("kato", {"train": 2, "test": 1}, "no val split: train with --val-split test, or make the set again"),
        ("kato", {"train": 2, "val": 1}, "no test split: evaluate with --split val, or make the set again"),
        ("kato", {"train": 2, "val": 1, "test": 1}, None),
        ("pascal3d", {"train": 2}, "no val split: training cannot be validated"),
        ("pascal3d", {"train": 2, "val": 1}, None),  # these layouts have no test and no val split
        ("r2n2", {"train": 2, "test": 1}, None),
    ],
)
def test_missing_splits_are_a_warning(layout, objects, said):
    (warning,) = missing_split_warnings(WRITERS[layout], objects) or [None]
    assert warning is said is None or (warning.startswith(said) and "3 meshes or more" in warning)


def test_two_shapes_end_with_a_warning(tmp_path):
    text = make_dataset(DatasetConfig(output=tmp_path, category="chair", procedural=2), progress=False).text()
    assert text.splitlines()[-1].startswith("warning: no val and no test split")
    assert (tmp_path / "03001627_report.txt").read_text() == text + "\n"


def test_command_line(tmp_path, folder, monkeypatch, capsys):
    command = ["make-dataset", "--output", str(tmp_path / "data"), "--category", "chair", "--source", str(folder)]
    monkeypatch.setattr("sys.argv", ["learn3d", *command])
    assert main() == 0 and "6 meshes used" in capsys.readouterr().out
    assert main() == 1 and capsys.readouterr().err.strip().splitlines()[-1].startswith("error: ")
