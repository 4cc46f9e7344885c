"""The whole recipe on tiny packages: placement, class rules, duplicates, what is replaced, errors."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from small_packages import AIRCRAFT, AIRPLANE, ac_object, ac_text, deb, fetch

from learn3d.make_data.debian.furniture import furniture_category


def test_recipe_writes_meshes_index_and_reasons(debs: Path, tmp_path: Path):
    trimesh = pytest.importorskip("trimesh")
    report = fetch(tmp_path / "out", debs)
    rows = list(csv.DictReader((tmp_path / "out/index.csv").open(encoding="utf-8")))
    assert [row["file"] for row in rows] == ["airplane/plane.ply", "chair/test-chair.ply", "table/test-table.ply"]
    assert [row["author"] for row in rows] == ["B. Maker", "A. Maker", "A. Maker"]
    assert [row["licence"] for row in rows] == ["GPL-2+", "Free Art License 1.3", "CC0"]
    assert {row["version"] for row in rows} == {"1:2.0-1"}
    assert rows[1]["source"] == "Test.sh3f!/m/chair.obj"
    reasons = {drop["title"]: drop["reason"] for drop in report.dropped}
    assert reasons["Red chair"] == "near-duplicate of chair/test-chair (surface IoU 1.000)"
    assert reasons["Tall chair"].startswith("stretched near-duplicate of chair/test-chair")
    assert "vertex" in reasons["Broken table"]
    assert ".dae" in reasons["Odd sofa"]
    assert report.ignored == 3  # the cup, the light and the balloon
    assert "non-free" not in report.summary() and "sweethome3d-furniture-nonfree" in report.summary()
    assert (tmp_path / "out/licences/sweethome3d-furniture.copyright").read_bytes() == b"Free-Art"
    for row in rows:
        mesh = trimesh.load(tmp_path / "out" / row["file"], process=False)
        assert (len(mesh.vertices), len(mesh.faces)) == (int(row["vertices"]), int(row["faces"]))
        assert mesh.extents.max() == pytest.approx(1, abs=1e-6)
        np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0, atol=1e-6)
        assert mesh.is_watertight == (row["watertight"] == "True")


def test_airplane_faces_front_without_its_disc(debs: Path, tmp_path: Path):
    trimesh = pytest.importorskip("trimesh")
    fetch(tmp_path / "out", debs, category="airplane")
    mesh = trimesh.load(tmp_path / "out/airplane/plane.ply", process=False)
    fin = mesh.vertices[mesh.vertices[:, 1].argmax()]
    tip = mesh.vertices[mesh.vertices[:, 1].argmin()]
    assert fin[2] < -0.3  # the fin is at the tail, so the nose points towards +z
    assert tip[0] > 0.3  # the left wing is at +x
    np.testing.assert_allclose(
        mesh.extents, [0.8, 0.4, 1.0], atol=1e-6
    )  # 0.801 in z with the disc in front of the nose


def test_two_runs_give_the_same_bytes(debs: Path, tmp_path: Path):
    for name in ("a", "b"):
        fetch(tmp_path / name, debs)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(tmp_path / "b") for path in (tmp_path / "b").rglob("*") if path.is_file())
    assert all((tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes() for file in files)


def test_duplicates_are_kept_when_asked_for(debs: Path, tmp_path: Path):
    report = fetch(tmp_path / "out", debs, category="chair", duplicate_iou=1, stretched_iou=1)
    assert [model["file"] for model in report.models] == [
        "chair/test-chair-2.ply",
        "chair/test-chair.ply",
        "chair/test-copy.ply",
    ]


def test_output_is_replaced_only_when_asked_and_ours(debs: Path, tmp_path: Path):
    out = tmp_path / "out"
    fetch(out, debs, category="chair")
    with pytest.raises(ValueError, match="--overwrite"):
        fetch(out, debs)
    fetch(out, debs, category="table", overwrite=True)
    assert sorted(path.name for path in out.iterdir()) == ["dropped.csv", "index.csv", "licences", "table"]
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "index.csv").write_text("id,name\n")
    with pytest.raises(ValueError, match="not written by this tool"):
        fetch(tmp_path / "precious", debs, overwrite=True)


def test_a_failure_leaves_nothing_behind(debs: Path, tmp_path: Path):
    deb(debs, "sweethome3d-furniture", {"usr/share/x.sh3f": b"no zip"})  # same name and version: replaces the good one
    with pytest.raises(ValueError, match=r"x\.sh3f is refused as a zip archive"):
        fetch(tmp_path / "out", debs)
    assert [path.name for path in tmp_path.iterdir()] == ["debs"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"category": "chair,car"}, "category .*car"),
        ({"category": " "}, "category must be some of"),
        ({"duplicate_iou": 0}, "duplicate_iou must be .*0"),
    ],
)
def test_bad_config(debs: Path, tmp_path: Path, more: dict, message: str):
    with pytest.raises(ValueError, match=message):
        fetch(tmp_path / "out", debs, **more)


def test_long_names_and_gaps_take_no_square_of_their_length(debs: Path, tmp_path: Path):
    """The square of a million takes hours."""
    assert furniture_category("chair") == "chair" and furniture_category("chair " + "knife " * 10**6) is None
    name = "prop" * 10**6
    text = ac_text(ac_object(name, (-5, 0, -0.5), (5, 1, 0.5)), *AIRPLANE)
    about = f"<author>B. Maker</author><path>{' ' * 10**6}x</path><path> Models/plane.ac\n</path>"
    files = {f"./{AIRCRAFT}/Plane/Models/plane.ac": text.encode(), f"./{AIRCRAFT}/Plane/plane.xml": about.encode()}
    deb(debs, "flightgear-data-ai", files)
    report = fetch(tmp_path / "out", debs, category="airplane")
    assert [(model["title"], model["author"]) for model in report.models] == [("Plane plane", "B. Maker")]
