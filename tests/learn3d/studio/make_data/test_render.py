"""From meshes to a data set: reading, framing, splitting, rendering, reports."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from lopsided_meshes import lopsided_mesh, make, write_meshes
from PIL import Image
from runs import contents

from learn3d.data.conventions import SET_FILE, mesh_to_object, shards_folder
from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import kato
from learn3d.studio.make_data import meshes, render
from learn3d.studio.make_data.writers import WRITERS
from learn3d.tasks import Workers

SYNSET = "03001627"


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


def test_meshes_of_every_format_are_named_and_counted(tmp_path, folder):
    """What is drawn of them: `data/test_round_trip.py`."""
    report = make(tmp_path / "data", folder)
    assert report.counts == {"train": 6} and not report.skipped
    names = json.loads((tmp_path / "data" / "03001627_card.json").read_text())["splits"]["train"]
    boxes = ["box0.obj", "box1.off", "box2.ply", "box3.stl", "box4.glb"]
    assert sorted(names) == [*boxes, "more/torus.PLY"]
    assert "6 meshes used, 0 skipped" in report.text()
    assert "_contact.png: rows: up to 6 objects" in report.text()


def test_up_and_front_turn_the_mesh(tmp_path):
    mesh = lopsided_mesh(0.5)
    for order, axes in (([0, 1, 2], {}), ([2, 0, 1], {"up": "z", "front": "y"})):
        (tmp_path / axes.get("up", "y")).mkdir()
        turned = trimesh.Trimesh(mesh.vertices[:, order], mesh.faces, process=False)
        turned.export(tmp_path / axes.get("up", "y") / "a.ply")
        make(tmp_path / f"data {axes.get('up', 'y')}", tmp_path / axes.get("up", "y"), **axes)
    (one, images), (other, same) = (load(tmp_path / f"data {up}") for up in "yz")
    np.testing.assert_array_equal(one.voxels, other.voxels)
    assert np.abs(images.astype(int) - same).mean() < 0.1 < images.std()


def test_bugs_are_raised_and_leave_no_files(tmp_path, folder, monkeypatch):
    for error in (IndexError, KeyboardInterrupt):

        def fail(*_, error=error, **__):
            raise error("a slip in the renderer")

        monkeypatch.setattr(render, "photograph", fail)
        with pytest.raises(error, match="a slip in the renderer"):
            make(tmp_path / "data", folder)
        assert list((tmp_path / "data").iterdir()) == []


def test_only_training_objects_get_scaled_copies(tmp_path, folder):
    report = make(tmp_path / "data", folder, test=2, val=1, augment=2)
    assert (
        report.counts == {"train": 9, "val": 1, "test": 2}
        and len(set(report.objects["train"])) == 9
    )
    dataset, _ = load(tmp_path / "data")
    name = json.loads((tmp_path / "data" / "03001627_card.json").read_text())["splits"]["train"][0]
    own = dataset.convention.voxelize(*placed(folder / name))[0].numpy()
    np.testing.assert_array_equal(dataset.voxels[0], own)
    assert not np.array_equal(dataset.voxels[1], own) and not np.array_equal(
        dataset.voxels[1], dataset.voxels[2]
    )
    for voxels in dataset.voxels:  # every copy fills the box again
        spans = [
            np.ptp(np.nonzero(voxels.any(axis=other))[0]) + 1 for other in ((1, 2), (0, 2), (0, 1))
        ]
        assert max(spans) >= 31


def test_meshes_and_shapes_may_be_mixed_and_only_meshes_get_copies(tmp_path, folder):
    names = make(tmp_path / "data", folder, procedural=5, front="z", test=0, augment=2).objects[
        "train"
    ]
    assert sorted(name for name in names if name.startswith("chair_")) == [
        f"chair_{i:05d}" for i in range(5)
    ]
    assert len(names) == 5 + 3 * 6


def test_split_is_test_then_val_then_train_of_one_permutation():
    order = np.random.default_rng(0).permutation(116)
    for test, val, sizes in (
        (0.2, 0.0, [23, 0, 93]),
        (7, 0.1, [7, 12, 97]),
        (0.01, 0, [4, 0, 112]),
    ):
        splits = meshes.split_meshes(116, test, val, 0)
        assert [len(splits[s]) for s in ("test", "val", "train")] == sizes
        np.testing.assert_array_equal(
            np.concatenate([splits[s] for s in ("test", "val", "train")]), order
        )
    for count in (1, 2, 3, 7, 39):
        small = meshes.split_meshes(count, 0.2, 0.1, 0)  # the defaults leave something to train on
        assert len(small["train"]) >= max(1, count // 3)
        assert min(len(small["test"]), len(small["val"])) >= min(4, count // 3)
    with pytest.raises(ValueError, match="leave none of the 10 meshes to train on"):
        meshes.split_meshes(10, 6, 4, 0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"source": "nowhere"}, "nowhere does not exist; give .* or a folder"),
        ({"source": "nothing"}, "there is no mesh"),
        ({"source": "bad"}, r"no mesh is left for training; .* a.obj: no faces"),
        ({"procedural": 3, "front": "x"}, "must have its axes: --up y --front z"),
        ({"source": None, "procedural": 3, "category": "unicorn"}, "procedural generator makes"),
        ({"up": "z", "front": "-z"}, "two different axes"),
        ({"out": "bad/a.obj"}, "a.obj"),
        ({"layout": "kato", "views": 12}, "views is always 24 in the layout kato, got 12"),
        ({"layout": "pascal3d", "test": 0.5}, "test is always 0"),
        (
            {"procedural": 1, "source": None, "layout": "pascal3d", "views": 1, "test": None},
            "two pictures or more",
        ),
        ({"layout": "kar", "shards": True}, "make the data set without --shards, and convert it"),
        ({"workers": Workers(2)}, "add --shards"),
    ],
)
def test_settings_and_folders_that_are_refused(tmp_path, folder, settings, message):
    for name in ("nothing", "bad"):
        (tmp_path / name).mkdir()
    (tmp_path / "bad" / "a.obj").write_text("v 0 0 0\n")
    settings = {"out": "data", "source": "meshes", **settings}
    out, source = tmp_path / settings.pop("out"), settings.pop("source")
    with pytest.raises((ValueError, OSError), match=message):
        make(out, None if source is None else tmp_path / source, **settings)
    assert not out.is_dir() or not list(out.iterdir())


def test_command_line(tmp_path, folder, command):
    words = ("make-dataset", "--output", tmp_path, "--category", "chair", "--source", folder)
    assert "6 meshes used" in command(*words)[1]
    status, _, said = command(*words)
    assert status == 1 and said.splitlines()[-1].startswith("error: ")


@pytest.mark.parametrize("layout", [name for name, writer in WRITERS.items() if writer.write])
def test_same_seed_same_bytes_whatever_the_order_of_the_folder(tmp_path, layout, monkeypatch):
    (tmp_path / "meshes").mkdir()
    folder = write_meshes(tmp_path / "meshes")
    settings = {"test": None, "val": None} | ({"views": 2} if WRITERS[layout].views else {})
    make(tmp_path / "a", folder, layout, **settings)
    listed = Path.rglob
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rglob", lambda self, pattern: reversed(list(listed(self, pattern))))
        make(tmp_path / "b", folder, layout, **settings)
    make(tmp_path / "c", folder, layout, **settings, seed=1)
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert a == b and a != c
    sheet = np.asarray(Image.open(tmp_path / "a" / f"{SYNSET}_contact.png"))
    assert sheet.shape[0] == 18 + 5 * 68 + 4
    assert sheet[18:, 40:104].std() > 10 and sheet[18:, -68:].std() > 10


def test_categories_share_a_folder_and_are_replaced_one_by_one(tmp_path, folder):
    make(tmp_path, folder, "kar", views=1)
    make(tmp_path, folder, "kar", views=1, category="table")
    image = tmp_path / "renders" / SYNSET / "box0" / "render_0.png"
    old = image.read_bytes()
    with pytest.raises(FileExistsError, match="--overwrite"):
        make(tmp_path, folder, "kar", views=2)
    make(tmp_path, folder, "kar", views=2, test=2, overwrite=True, seed=5)
    assert image.read_bytes() != old
    splits = json.loads((tmp_path / "splits.json").read_text())
    assert {key: len(value["test"]) for key, value in splits.items()} == {SYNSET: 2, "04379243": 0}
    assert not list(tmp_path.glob(".make_dataset_*"))
    (tmp_path / "splits.json").write_text("{")
    with pytest.raises(ValueError, match=r"splits\.json"):
        make(tmp_path, folder, "kar", overwrite=True)
    assert (tmp_path / "splits.json").read_text() == "{"


def test_names_of_objects_are_fit_for_files_and_differ_by_more_than_case() -> None:
    paths = (
        "a.obj",
        "a_2.obj",
        "A!.obj",
        "-a.obj",
        "b/c d.ply",
        "..ply.ply",
        "!.stl",
        "x" * 300 + ".off",
    )
    names = meshes.object_names(paths)
    assert names == ["a", "a_2", "A_3", "a_4", "b_c_d", "ply", "mesh", "x" * 80]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (None, "an npz file with v0"),
        ({"n": 3}, "there is no mesh"),
        ({"v0": np.array([{}], dtype=object)}, "pickled objects"),
        ({"v0": np.eye(3)}, "f0"),
        ({"v0": np.eye(3), "f0": np.eye(3)}, "not a triangle mesh"),
    ],
)
def test_packs_that_are_refused(tmp_path: Path, arrays: dict | None, message: str) -> None:
    path = tmp_path / "a.npz"
    path.write_text("<html>")
    if arrays is not None:
        np.savez(path, **arrays)
    with pytest.raises(ValueError, match=message):
        make(tmp_path / "data", path)


def test_a_pack_becomes_a_data_set(tmp_path: Path) -> None:
    boxes = [trimesh.creation.box((1.0, 0.2 + 0.1 * i, 0.5)) for i in range(3)]
    arrays = {f"v{i}": b.vertices.astype(np.float32) for i, b in enumerate(boxes)}
    arrays |= {f"f{i}": b.faces.astype(np.int32) for i, b in enumerate(boxes)}
    np.savez(tmp_path / "pack.npz", n=3, **arrays)
    assert make(tmp_path / "data", tmp_path / "pack.npz").counts == {"train": 3}


def test_meshes_without_faces_and_broken_files_are_skipped_and_listed(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for k in range(3):
        trimesh.creation.box(extents=(1, 1 + k, 2)).export(source / f"box{k}.ply")
    box = (source / "box0.ply").read_bytes()
    bad = {
        "empty.off": ("OFF\n0 0 0\n", "no faces"),
        "points.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
        "nan.obj": ("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", "line 2: 'v 1 0 nan' cannot be read"),
        "point.obj": ("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "longest side is 0"),
        "line.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no view shows"),
        "index.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", ""),
        "text.obj": ("this is no mesh\n", ""),
        "short.glb": (b"glTF\x02", ""),
        "cut.ply": (box[:120], ""),
        "huge.ply": (box.replace(b"vertex 8", b"vertex 9999999999"), ""),
    }
    for name, (content, _) in bad.items():
        (source / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    report = make(tmp_path / "data", source)
    reasons = {mesh["name"]: mesh["reason"] for mesh in report.skipped}
    assert reasons.keys() == bad.keys() and report.counts == {"train": 3}
    assert all(reasons[name] and expected in reasons[name] for name, (_, expected) in bad.items())
    assert "3 meshes used, 10 skipped" in report.text()
    assert all(f"skipped {name} (train): " in report.text() for name in bad)


TRIANGLE, FACE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (TRIANGLE, FACE + 1, r"refer to vertices 1 \.\. 3"),
        (TRIANGLE, FACE - 1, "refer to vertices -1"),
        (np.where(TRIANGLE > 0, np.inf, TRIANGLE), FACE, "extent"),
        (
            TRIANGLE,
            np.broadcast_to(FACE, (meshes.MAX_FACES + 1, 3)),
            "1000001 faces, the limit is 1000000",
        ),
    ],
)
def test_arrays_that_are_refused(vertices: np.ndarray, faces: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        meshes.check(meshes.RawMesh(vertices, faces))


def test_vertices_that_no_face_uses_are_dropped_unchecked() -> None:
    stray = np.vstack([TRIANGLE, [[np.nan] * 3], [[50.0] * 3]])
    np.testing.assert_array_equal(meshes.check(meshes.RawMesh(stray, FACE)).vertices, TRIANGLE)


def test_shards_of_the_category_would_be_read_instead(tmp_path, folder):
    shards = shards_folder(tmp_path / "data", "chair", "test")
    shards.mkdir(parents=True)
    (shards / SET_FILE).write_text("{}")
    with pytest.raises(FileExistsError, match="has shards of chair, which are read before"):
        make(tmp_path / "data", folder)
