"""Meshes -> Kato's layout: formats, frames, splits, bad meshes, determinism, errors."""

from __future__ import annotations

import json
import shutil
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import trimesh

import nmr
from learn3d.commands import main
from learn3d.data import conventions
from learn3d.data.conventions import mesh_to_object
from learn3d.data.readers import kato
from learn3d.make_data import meshes, render
from learn3d.make_data.render import DatasetConfig, make_dataset, split_objects
from learn3d.make_data.report import missing_split_warnings
from learn3d.make_data.writers import WRITERS
from learn3d.pictures.contact_sheet import draw_sheet, make_row


@pytest.fixture
def folder(tmp_path):
    """Six small meshes, one per file format (two PLY), of different size and place."""
    path = tmp_path / "meshes"
    (path / "more").mkdir(parents=True)
    for i, suffix in enumerate(("obj", "off", "ply", "stl", "glb")):
        box = trimesh.creation.box((1.0 + i, 2.0, 0.5))
        box.apply_translation((10.0 * i, -3.0, 5.0))
        box.export(path / f"box{i}.{suffix}")
    trimesh.creation.torus(1.0, 0.3).export(path / "more" / "torus.PLY", file_type="ply")
    return path


def make(out, source, **settings):
    config = {"category": "chair", "test": 0, "val": 0, **settings}
    return make_dataset(DatasetConfig(output=Path(out), source=source, **config), progress=False)


def load(folder, category, split):
    """What the reader makes of the files, views sorted by object."""
    dataset = kato.load(folder, category, split)
    images = dataset.images.reshape(-1, 24, 4, 64, 64)
    return SimpleNamespace(
        images=images, voxels=dataset.voxels, voxelize=dataset.voxelize, cameras=conventions.view_cameras
    )


def placed(mesh, up="y", front="x"):
    """Vertices in the object frame and faces, as torch tensors."""
    vertices = meshes.fit_to_box(mesh.vertices @ mesh_to_object(up, front).T)
    return torch.tensor(vertices, dtype=torch.float32), torch.tensor(np.asarray(mesh.faces))


def test_every_format_round_trips_through_the_reader(tmp_path, folder):
    report = make(tmp_path / "data", folder)
    assert report.objects == {"train": 6} and not report.skipped
    assert all(mesh["watertight"] for mesh in report.used)
    assert {mesh["name"]: mesh["faces"] for mesh in report.used}["box3.stl"] == 12
    dataset = load(tmp_path / "data", "chair", "train")
    assert dataset.images.shape == (6, 24, 4, 64, 64) and dataset.voxels.shape == (6, 32, 32, 32)
    card = json.loads((tmp_path / "data" / "03001627_card.json").read_text())
    names = card["splits"]["train"]
    assert sorted(names) == ["box0.obj", "box1.off", "box2.ply", "box3.stl", "box4.glb", "more/torus.PLY"]
    # the alpha is the renderer's silhouette and the true mesh has IoU 1 with its own voxels
    for number, name in enumerate(names):
        vertices, faces = placed(trimesh.load(folder / name, force="mesh", process=False))
        assert torch.equal(dataset.voxelize(vertices, faces)[0], torch.from_numpy(dataset.voxels[number])), name
        alpha = nmr.render_silhouette(vertices, faces, dataset.cameras(torch.arange(24)), image_size=64)
        np.testing.assert_array_equal(dataset.images[number, :, 3], np.rint(255 * alpha.numpy()), err_msg=name)
    # black where nothing is, lit elsewhere: colours are stored inverted
    empty = dataset.images[:, :, 3] == 0
    assert (dataset.images[:, :, :3].max(axis=2)[empty] == 0).all()
    assert (dataset.images[:, :, :3].max(axis=2)[dataset.images[:, :, 3] == 255] > 0).all()
    sheet = imageio.imread(tmp_path / "data" / "03001627_contact.png")
    assert sheet.shape[0] == 18 + 6 * 68 + 4 and sheet.std() > 10
    said = (tmp_path / "data" / "03001627_report.txt").read_text()
    assert "6 meshes used, 0 skipped" in said
    assert (
        "03001627_contact.png: rows: up to 6 objects of each split; columns: up to 8 views, the mask of view 0" in said
    )


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
    slab = trimesh.creation.box((1, 1, 1))
    slab.vertices = slab.vertices @ np.stack([1.0 * f, 0.1 * u, 1.0 * right])
    post = trimesh.creation.box((1, 1, 1))
    post.vertices = post.vertices @ np.stack([0.1 * f, 0.6 * u, 0.1 * right]) + 0.4 * f + 0.3 * u - 0.4 * right
    mesh = trimesh.util.concatenate([slab, post])
    (tmp_path / "in").mkdir()
    mesh.export(tmp_path / "in" / "post.ply")
    make(tmp_path / "data", tmp_path / "in", up=up, front=front)
    dataset = load(tmp_path / "data", "chair", "train")
    for view, side in ((0, "left"), (6, "right"), (12, "right"), (18, "left")):
        alpha = dataset.images[0, view, 3].astype(float)
        rows = np.nonzero(alpha.any(axis=1))[0]
        top = alpha[rows[0] : rows[0] + 4].sum(axis=0)  # row 0 is the top: the head of the post is up there
        column = (top * np.arange(64)).sum() / top.sum()
        assert (column < 28) if side == "left" else (column > 36), (view, side, column)
    # voxel axes (y, x, -z) of the object frame: up, right as seen from the front, towards the front
    top = np.argwhere(dataset.voxels[0][16:].any(axis=0)).mean(axis=0)
    assert top[0] < 8 and top[1] > 24


def test_scene_transforms_are_applied(tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    scene = trimesh.Scene()
    for x, angle in ((0.0, 0.0), (3.0, 0.5)):
        matrix = trimesh.transformations.rotation_matrix(angle, (0, 1, 0))
        matrix[0, 3] = x
        scene.add_geometry(box, transform=matrix)
    (tmp_path / "in").mkdir()
    scene.export(tmp_path / "in" / "two.glb")
    make(tmp_path / "data", tmp_path / "in")
    dataset = load(tmp_path / "data", "chair", "train")
    vertices, faces = placed(scene.to_geometry() if hasattr(scene, "to_geometry") else scene.dump(concatenate=True))
    assert len(faces) == 24
    iou = (dataset.voxelize(vertices, faces)[0].numpy() & dataset.voxels[0]).sum() / dataset.voxels[0].sum()
    assert iou > 0.98  # glb keeps float32
    assert not dataset.voxels[0].any(axis=(0, 1))[14:17].all()  # a gap between the two along mesh x


def test_bad_meshes_are_reported_and_the_others_made(tmp_path, folder):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=float)
    (folder / "broken.obj").write_text("this is no mesh\n")
    (folder / "broken.glb").write_bytes(b"glTF\x02")
    (folder / "broken.ply").write_bytes(b"\x00\x01\x02")
    (folder / "empty.off").write_text("OFF\n0 0 0\n")
    (folder / "nan.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")
    (folder / "point.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
    (folder / "line.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    (folder / "index.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n")
    trimesh.PointCloud(vertices).export(folder / "points.ply")
    trimesh.creation.icosphere(4).export(folder / "large.stl")
    (folder / "notes.doc").write_text("not a mesh")
    (folder / "scene.dae").write_text("trimesh reads it with another package only")
    report = make(tmp_path / "data", folder, max_faces=5000)
    reasons = {mesh["name"]: mesh["reason"] for mesh in report.skipped}
    assert report.objects == {"train": 6} and len(load(tmp_path / "data", "chair", "train").images) == 6
    assert set(reasons) == {
        "broken.obj", "broken.glb", "broken.ply", "empty.off", "nan.obj", "point.obj", "line.obj", "index.off",
        "points.ply", "large.stl",
    }  # fmt: skip
    assert "no faces" in reasons["empty.off"] and "no faces" in reasons["points.ply"]
    assert "not finite" in reasons["nan.obj"] and "longest side" in reasons["point.obj"]
    assert "no view shows" in reasons["line.obj"]
    assert "5120 faces, the limit is 5000" in reasons["large.stl"]
    assert all(reasons.values()) and report.ignored_files == {".dae": 1, ".doc": 1}
    text = (tmp_path / "data" / "03001627_report.txt").read_text()
    assert "10 skipped" in text and "skipped nan.obj (train)" in text and "ignored 1 .doc" in text


def test_our_own_mistakes_are_not_taken_for_bad_meshes(tmp_path, folder, monkeypatch):
    def fail(*_, **__):
        raise IndexError("a slip in the renderer")

    monkeypatch.setattr(render, "photograph", fail)
    with pytest.raises(IndexError, match="a slip in the renderer"):
        make(tmp_path / "data", folder)


def test_only_formats_that_the_reader_knows_count_as_meshes():
    known = trimesh.available_formats()
    assert {extension.lstrip(".") for extension in meshes.EXTENSIONS} <= known


def test_checks_of_arrays():
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    face = np.array([[0, 1, 2]])
    stray = np.vstack([triangle, [[np.nan] * 3], [[50.0] * 3]])  # vertices that no face uses do not count
    np.testing.assert_array_equal(meshes.checked(meshes.RawMesh(stray, face), 10).vertices, triangle)
    cases = [
        (triangle[:, :2], face, "not a triangle mesh"),
        (triangle, face.astype(float), "not a triangle mesh"),
        (triangle, face + 1, r"refer to vertices 1 \.\. 3"),
        (triangle, face - 1, "refer to vertices -1"),
        (np.where(triangle > 0, np.inf, triangle), face, "not finite"),
        (triangle * 1e300, face, "extent"),
    ]
    for vertices, faces, message in cases:
        with pytest.raises(ValueError, match=message):
            meshes.checked(meshes.RawMesh(vertices, faces), 10)


def test_watertight():
    box = trimesh.creation.box((1, 1, 1))
    soup = box.vertices[box.faces].reshape(-1, 3)
    assert meshes.is_watertight(soup, np.arange(36).reshape(-1, 3))
    assert not meshes.is_watertight(box.vertices, box.faces[1:])
    two = trimesh.util.concatenate([box, box.copy().apply_translation((1, 0, 0))])  # closed parts that touch
    assert meshes.is_watertight(two.vertices, two.faces)
    assert not meshes.is_watertight(box.vertices, np.array([[0, 0, 0]]))


def test_same_seed_same_bytes_whatever_the_order_of_the_folder(tmp_path, folder, monkeypatch):
    settings = {"test": 2, "val": 1, "augment": 1, "seed": 3}
    make(tmp_path / "a", folder, **settings)
    listed = Path.rglob
    monkeypatch.setattr(Path, "rglob", lambda self, pattern: reversed(list(listed(self, pattern))))
    make(tmp_path / "b", folder, **settings)
    names = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "b").iterdir()) and len(names) == 10
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    make(tmp_path / "c", folder, **{**settings, "seed": 4})
    other = load(tmp_path / "c", "chair", "train").images
    assert not np.array_equal(load(tmp_path / "a", "chair", "train").images, other)


def test_only_training_objects_get_scaled_copies(tmp_path, folder):
    report = make(tmp_path / "data", folder, test=2, val=1, augment=2)
    assert report.objects == {"train": 9, "val": 1, "test": 2}
    train = load(tmp_path / "data", "chair", "train")
    name = json.loads((tmp_path / "data" / "03001627_card.json").read_text())["splits"]["train"][0]
    vertices, faces = placed(trimesh.load(folder / name, force="mesh", process=False))
    own = train.voxelize(vertices, faces)[0].numpy()
    np.testing.assert_array_equal(train.voxels[0], own)
    assert not np.array_equal(train.voxels[1], own) and not np.array_equal(train.voxels[1], train.voxels[2])
    for voxels in train.voxels:  # every copy fills the box again
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
    assert len(split_objects(10, 6, 3, 0)["train"]) == 1
    for count in range(1, 40):
        small = split_objects(count, 0.2, 0.1, 0)  # the tool's defaults leave something to train on
        assert len(small["train"]) >= max(1, count // 3)
        assert min(len(small["test"]), len(small["val"])) >= min(4, count // 3)
    for bad in ((-1, 0), (2.5, 0), (8, 4), (6, 4), (float("nan"), 0)):
        with pytest.raises(ValueError, match=r"share|leave none of the 10 meshes to train on"):
            split_objects(10, *bad, 0)


def test_mesh_packs(tmp_path):
    boxes = [trimesh.creation.box((1.0, 0.2 + 0.1 * i, 0.5)) for i in range(3)]
    arrays = {f"v{i}": b.vertices.astype(np.float32) for i, b in enumerate(boxes)}
    arrays |= {f"f{i}": b.faces.astype(np.int32) for i, b in enumerate(boxes)}
    np.savez(tmp_path / "pack.npz", n=3, **arrays)
    assert make(tmp_path / "data", tmp_path / "pack.npz").objects == {"train": 3}
    np.savez(tmp_path / "bad.npz", n=4, **arrays)
    with pytest.raises(ValueError, match=r"missing keys: \['v3', 'f3'\]"):
        make(tmp_path / "other", tmp_path / "bad.npz")
    (tmp_path / "html.npz").write_text("<html>")
    with pytest.raises(ValueError, match="cannot read the mesh pack"):
        make(tmp_path / "other", tmp_path / "html.npz")


def test_colours_of_the_mesh_or_random_ones(tmp_path):
    (tmp_path / "in").mkdir()
    box = trimesh.creation.box((1, 1, 1))
    box.visual.face_colors = np.tile([255, 0, 0, 255], (12, 1))
    box.export(tmp_path / "in" / "red.ply")
    for color in ("mesh", "random"):
        make(tmp_path / color, tmp_path / "in", color=color)
        record = load(tmp_path / color, "chair", "train").images[0]
        inside = record[:, :3].transpose(0, 2, 3, 1)[
            record[:, 3] == 255
        ]  # inverted: red is (0, 255, 255) at full light
        red = (inside[:, 1] == 255) & (inside[:, 2] == 255) & (inside[:, 0] < 255)
        assert red.all() if color == "mesh" else not red.any()
        assert len(np.unique(inside[:, 0])) >= 3  # faces differ in light
    make(tmp_path / "seed1", tmp_path / "in", seed=1)
    a, b = (load(tmp_path / name, "chair", "train").images for name in ("random", "seed1"))
    assert np.array_equal(a[:, :, 3], b[:, :, 3]) and not np.array_equal(a, b)


def test_procedural_shapes(tmp_path):
    config = DatasetConfig(output=tmp_path, category="chair", procedural=3, test=1, val=0)
    assert make_dataset(config, progress=False).objects == {"train": 2, "test": 1}
    with pytest.raises(ValueError, match="procedural generator makes"):
        make_dataset(DatasetConfig(output=tmp_path, category="unicorn", procedural=3), progress=False)


def test_refuses_to_overwrite_and_removes_what_is_stale(tmp_path, folder):
    make(tmp_path / "data", folder, test=2)
    with pytest.raises(FileExistsError, match="--overwrite"):
        make(tmp_path / "data", folder)
    make(tmp_path / "data", folder, category="table")  # another category may live in the same folder
    make(tmp_path / "data", folder, overwrite=True)
    left = sorted(path.name for path in (tmp_path / "data").glob("03001627*.npz"))
    assert left == ["03001627_train_images.npz", "03001627_train_voxels.npz"]


def test_nothing_is_left_behind_when_it_fails(tmp_path, folder, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(render, "photograph", interrupt)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "data", folder)
    assert list((tmp_path / "data").iterdir()) == []


def test_errors_of_settings_and_folders(tmp_path, folder, monkeypatch):
    with pytest.raises(FileNotFoundError, match="no folder or mesh pack"):
        make(tmp_path / "data", tmp_path / "nowhere")
    with pytest.raises(ValueError, match="folder of meshes or a mesh pack"):
        make(tmp_path / "data", folder / "box0.obj")
    (tmp_path / "nothing").mkdir()
    with pytest.raises(ValueError, match="no mesh file"):
        make(tmp_path / "data", tmp_path / "nothing")
    with pytest.raises(ValueError, match="either --source"):
        make(tmp_path / "data", folder, procedural=3)
    with pytest.raises(ValueError, match="either --source"):
        make(tmp_path / "data", None)
    with pytest.raises(ValueError, match="augment must be at least 0"):
        make(tmp_path / "data", folder, augment=-1)
    with pytest.raises(ValueError, match="color"):
        make(tmp_path / "data", folder, color="blue")
    with pytest.raises(ValueError, match="two different axes"):
        make(tmp_path / "data", folder, up="z", front="-z")
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="cannot write"):
        make(tmp_path / "file", folder)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "a.obj").write_text("v 0 0 0\n")
    with pytest.raises(ValueError, match=r"none of the 1 meshes .* a.obj: no faces"):
        make(tmp_path / "data", tmp_path / "bad")
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(2**30, 2**30, 1000))
    with pytest.raises(OSError, match="MiB free"):
        make(tmp_path / "data", folder)


def test_a_data_set_without_training_objects_is_not_made(tmp_path, folder):
    train = split_objects(6, 2, 2, seed=0)["train"]
    sources, _ = meshes.folder_sources(folder)
    for number in train:
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


def test_two_meshes_end_with_a_warning(tmp_path):
    config = DatasetConfig(output=tmp_path, category="chair", procedural=2)
    text = make_dataset(config, progress=False).text()
    assert text.splitlines()[-1].startswith("warning: no val and no test split")
    assert (tmp_path / "03001627_report.txt").read_text() == text + "\n"


def test_the_contact_sheet_names_its_columns_and_splits():
    rgb, alpha = np.full((24, 64, 64, 3), 255, np.uint8), np.zeros((24, 64, 64), np.uint8)
    row = make_row(rgb, alpha, np.zeros((32, 32, 32), bool))
    assert len(row) == 10 and len(make_row(rgb[:3], alpha[:3], np.zeros((32, 32, 32), bool))) == 5
    sheet = draw_sheet({"train": [row] * 9, "val": [], "test": [row]}, 24)
    left = sheet.shape[1] - 10 * 68 - 4
    assert sheet.shape[0] == 18 + 7 * 68 + 4 and left > 10
    titles = [(sheet[:17, left + 68 * k : left + 68 * (k + 1)] < 100).any() for k in range(10)]
    names = [(sheet[22 + 68 * k : 86 + 68 * k, :left] < 100).any() for k in range(7)]
    assert titles == [True] * 10 and names == [True, *[False] * 5, True]


def test_voxels_on_the_contact_sheet_do_not_touch():
    row = make_row(np.full((1, 64, 64, 3), 255, np.uint8), np.zeros((1, 64, 64), np.uint8), np.ones((32, 32, 32), bool))
    column = draw_sheet({"train": [row, row]}, 1)[22:, -36]
    assert (column[:64] == 0).all() and (column[64:68] > 0).all() and (column[68:132] == 0).all()


def test_a_mesh_that_cannot_be_seen_is_skipped(tmp_path, folder):
    (folder / "line.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    (skipped,) = make(tmp_path / "data", folder).skipped
    assert skipped["name"] == "line.obj" and "no view shows" in skipped["reason"]


def test_command_line(tmp_path, folder, monkeypatch, capsys):
    command = ["make-dataset", "--output", str(tmp_path / "data"), "--category", "chair", "--source", str(folder)]
    monkeypatch.setattr("sys.argv", ["learn3d", *command])
    assert main() == 0 and "6 meshes used" in capsys.readouterr().out
    assert main() == 1 and capsys.readouterr().err.strip().splitlines()[-1].startswith("error: ")
