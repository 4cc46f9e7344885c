"""Properties of every layout that make_dataset writes: bytes, names, shared folders."""

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


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("layout", WRITERS)
def test_same_seed_same_bytes_whatever_the_order_of_the_folder(tmp_path, folder, layout, monkeypatch):
    settings = {"test": None, "val": None} | ({} if WRITERS[layout].fixed_views else {"views": 2})
    report = make(tmp_path / "a", folder, layout, **settings)
    listed = Path.rglob
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rglob", lambda self, pattern: reversed(list(listed(self, pattern))))
        make(tmp_path / "b", folder, layout, **settings)
    make(tmp_path / "c", folder, layout, **settings, seed=1)
    a, b, c = (contents(tmp_path / name) for name in "abc")
    assert a == b and a != c
    assert {Path(name).parts[0] for name in report.files} == {path.name for path in (tmp_path / "a").iterdir()}
    sheet = np.asarray(Image.open(tmp_path / "a" / f"{SYNSET}_contact.png"))
    assert sheet.shape[0] == 18 + 5 * 68 + 4
    assert sheet[18:, 40:104].std() > 10 and sheet[18:, -68:].std() > 10


def test_every_layout_has_a_writer():
    assert WRITERS.keys() == LAYOUTS.keys()


def test_categories_share_a_folder_and_are_replaced_one_by_one(tmp_path, folder):
    make(tmp_path, folder, "kar", views=1)
    make(tmp_path, folder, "kar", views=1, category="table")
    image = tmp_path / "renders" / SYNSET / "my_chair_0" / "render_0.png"
    old = image.read_bytes()
    make(tmp_path, folder, "kar", views=2, test=2, overwrite=True, seed=5)
    assert image.read_bytes() != old
    splits = json.loads((tmp_path / "splits.json").read_text())
    assert {key: len(value["test"]) for key, value in splits.items()} == {SYNSET: 2, "04379243": 0}
    assert not list(tmp_path.glob(".make_dataset_*"))


@pytest.mark.parametrize("content", ["{", "[]"])
def test_a_damaged_list_of_splits_is_not_replaced(tmp_path, folder, content):
    (tmp_path / "splits.json").write_text(content)
    with pytest.raises(ValueError, match=r"splits\.json"):
        make(tmp_path, folder, "kar")


def test_copies_of_training_objects_have_names_of_their_own(tmp_path, folder):
    make(tmp_path, folder, "dvr", augment=1, test=1)
    names = (tmp_path / SYNSET / "softras_train.lst").read_text().split()
    assert len(set(names)) == 8 and sorted(n.endswith("-1") for n in names) == [False] * 4 + [True] * 4


def test_names_are_fit_for_files_and_differ(tmp_path):
    source = tmp_path / "in"
    (source / "a").mkdir(parents=True)
    for name in ("a/b.ply", "a b.ply", "a_B.stl", "..ply.ply"):
        lopsided_mesh(0.5).export(source / name)
    make(tmp_path / "out", source, "photos", views=1)
    with open(tmp_path / "out" / "chair" / "poses.csv", newline="") as file:
        names = {row["object"].lower() for row in csv.DictReader(file)}
    assert len(names) == 4 and all(name.replace("_", "").isalnum() for name in names)


def test_r2n2_moves_objects_between_splits_if_meshes_are_skipped(tmp_path):
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
