"""What is the same for every layout that make_dataset writes: bytes, names, splits, folders shared, errors."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from lopsided_meshes import lopsided_mesh, make, write_meshes
from PIL import Image

from learn3d.data.layouts import LAYOUTS
from learn3d.make_data.writers import WRITERS

SYNSET = "03001627"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_meshes(tmp_path_factory.mktemp("meshes"))


@pytest.mark.parametrize("layout", ["dvr", "kar", "r2n2", "pascal3d", "photos"])
def test_same_seed_same_bytes_and_nothing_else_in_the_folder(tmp_path, folder, layout):
    views = {} if layout == "dvr" else {"views": 2}
    settings = {"test": None, "val": None, **views}
    report = make(tmp_path / "a", folder, layout, **settings)
    make(tmp_path / "b", folder, layout, **settings)
    a, b = ({p.relative_to(tmp_path / n): p for p in (tmp_path / n).rglob("*") if p.is_file()} for n in "ab")
    assert a.keys() == b.keys() and all(a[key].read_bytes() == b[key].read_bytes() for key in a)
    make(tmp_path / "c", folder, layout, **settings, seed=1)
    c = {p.relative_to(tmp_path / "c"): p.read_bytes() for p in (tmp_path / "c").rglob("*") if p.is_file()}
    assert any(c.get(key) != path.read_bytes() for key, path in a.items())
    tops = {Path(name).parts[0] for name in report.files}
    assert tops == {path.name for path in (tmp_path / "a").iterdir()}
    sheet = np.asarray(Image.open(tmp_path / "a" / f"{SYNSET}_contact.png"))
    assert sheet.shape[0] == 18 + 5 * 68 + 4
    assert sheet[18:, 40:104].std() > 10 and sheet[18:, -68:].std() > 10


def test_categories_share_a_folder_and_are_replaced_one_by_one(tmp_path, folder):
    make(tmp_path, folder, "kar", views=1)
    make(tmp_path, folder, "kar", views=1, category="table")
    with pytest.raises(FileExistsError, match="--overwrite"):
        make(tmp_path, folder, "kar", views=1)
    old = (tmp_path / "renders" / SYNSET / "my_chair_0" / "render_0.png").read_bytes()
    make(tmp_path, folder, "kar", views=2, test=2, overwrite=True, seed=5)
    assert (tmp_path / "renders" / SYNSET / "my_chair_0" / "render_0.png").read_bytes() != old
    splits = json.loads((tmp_path / "splits.json").read_text())
    assert {key: len(value["test"]) for key, value in splits.items()} == {SYNSET: 2, "04379243": 0}
    assert not list(tmp_path.glob(".make_dataset_*"))


def test_copies_of_training_objects_have_names_of_their_own(tmp_path, folder):
    report = make(tmp_path, folder, "dvr", augment=1, test=1)
    assert report.objects == {"train": 8, "test": 1}
    names = (tmp_path / SYNSET / "softras_train.lst").read_text().split()
    assert len(set(names)) == 8 and sorted(n.endswith("-1") for n in names) == [False] * 4 + [True] * 4
    clouds = [np.load(tmp_path / SYNSET / name / "pointcloud.npz")["points"] for name in sorted(names)[:2]]
    assert np.abs(np.ptp(clouds[0], axis=0) - np.ptp(clouds[1], axis=0)).max() > 0.02


def test_names_are_fit_for_files_and_differ(tmp_path):
    source = tmp_path / "in"
    (source / "a").mkdir(parents=True)
    for name in ("a/b.ply", "a b.ply", "a_B.stl", "..ply.ply"):
        lopsided_mesh(0.5).export(source / name)
    make(tmp_path / "out", source, "photos", views=1)
    with open(tmp_path / "out" / "chair" / "poses.csv", newline="") as file:
        names = {row["object"].lower() for row in csv.DictReader(file)}
    assert len(names) == 4 and all(name.replace("_", "").isalnum() for name in names)


def test_r2n2_moves_objects_between_splits_where_meshes_are_skipped(tmp_path, folder):
    source = tmp_path / "in"
    source.mkdir()
    for i in range(12):
        lopsided_mesh(0.5).export(source / f"{i}.ply")
    for i in (1, 4):
        (source / f"{i}.ply").write_text("damaged")
    report = make(tmp_path / "out", source, "r2n2", views=1, test=None, val=None)
    assert report.objects == {"train": 8, "test": 2} and len(report.skipped) == 2
    names = sorted(path.name for path in (tmp_path / "out" / "ShapeNetRendering" / SYNSET).iterdir())
    tested = {mesh["name"] for mesh in report.used if mesh["split"] == "test"}
    assert tested == {name[6:] + ".ply" for name in names[8:]}


def test_errors_of_settings(tmp_path, folder):
    cases = [
        ({"layout": "coco"}, "layout must be .*kato"),
        ({"layout": "kato", "views": 12}, "24 views"),
        ({"layout": "kar", "views": 0}, "views must be at least 1"),
        ({"layout": "r2n2", "val": 1, "test": None}, "no val split"),
        ({"layout": "r2n2", "augment": 2, "test": None}, "first 80 %"),
        ({"layout": "r2n2", "test": 0.5}, "first 80 %"),
        ({"layout": "pascal3d", "test": 0.2}, "no test split"),
    ]
    for settings, message in cases:
        with pytest.raises(ValueError, match=message):
            make(tmp_path / "out", folder, **settings)
    (tmp_path / "kar").mkdir()
    for content in ("{", "[]"):
        (tmp_path / "kar" / "splits.json").write_text(content)
        with pytest.raises(ValueError, match=r"splits\.json"):
            make(tmp_path / "kar", folder, "kar")
    single = tmp_path / "single"
    single.mkdir()
    lopsided_mesh(0.5).export(single / "one.ply")
    with pytest.raises(ValueError, match="two pictures"):
        make(tmp_path / "out", single, "pascal3d", views=1, test=None)
    with pytest.raises(ValueError, match="two objects"):
        make(tmp_path / "out", single, "r2n2", test=None, views=1)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_every_layout_has_a_writer():
    assert len({WRITERS[layout] for layout in LAYOUTS}) == len(LAYOUTS)
