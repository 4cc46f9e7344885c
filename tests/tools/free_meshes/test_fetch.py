"""Meshes from Debian packages."""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import fetch
import numpy as np
import pytest
import trimesh
from ac3d import read_ac3d
from fetch import clean_mesh, fetch_models, surface_grid
from packages import (
    NOT_AIRPLANES,
    furniture_category,
    place_furniture,
    read_catalogue,
    remove_effects,
)
from small_packages import (
    AIRCRAFT,
    AIRPLANE,
    CHAIR,
    TABLE,
    ac_object,
    ac_text,
    box,
    catalogue,
    deb,
    entry,
)

from learn3d.files.formats import RawMesh
from nmr.obj import triangulate


def cut(vertices: np.ndarray, polygons: np.ndarray) -> RawMesh:
    """The mesh of polygons [P, N] of one size."""
    sizes = np.full(len(polygons), np.shape(polygons)[1])
    return RawMesh(vertices, np.ravel(polygons)[triangulate(vertices, np.ravel(polygons), sizes)])


@pytest.fixture
def debs(tmp_path: Path) -> Path:
    """A catalogue with a chair, its copy, a stretched copy, a table, a cup; an airplane, a light and a balloon."""
    if shutil.which("dpkg-deb") is None:
        pytest.skip("needs dpkg-deb")
    entries = [
        entry("Oak chair", "chair"),
        entry("Red chair", "copy"),
        entry("Tall chair", "tall", width="4", height="30", depth="4"),
        entry("Table", "table", license="CC0"),
        entry("Cup", "cup"),
        entry("Broken table", "broken"),
        entry("Lost table", "lost"),
        entry("Odd sofa", "odd", model="/m/odd.dae"),
    ]
    models = {"m/chair.obj": CHAIR, "m/copy.obj": CHAIR, "m/tall.obj": CHAIR, "m/table.obj": TABLE}
    models["m/broken.obj"] = "v 0 0 0\nf 1 2 3"
    folder, sh3f = tmp_path / "debs", {"usr/Test.sh3f": catalogue(entries, models)}
    deb(
        folder,
        "sweethome3d-furniture",
        sh3f | {"usr/share/doc/sweethome3d-furniture/copyright": b"Free-Art"},
    )
    deb(folder, "sweethome3d-furniture-nonfree", {})
    disc = ac_object("thing", (-5.01, -1, -1), (-5, 1, 1))
    aircraft = {
        "Plane/plane-main.xml": "<author>B.\n Maker</author><path> Models/plane.ac</path>",
        "Plane/Models/plane.ac": ac_text(*AIRPLANE, disc),
        "Plane/Models/lights/RedLight.ac": ac_text(AIRPLANE[0]),
        "balloon/Models/balloon1.ac": ac_text(AIRPLANE[0]),
    }
    deb(
        folder,
        "flightgear-data-ai",
        {f"{AIRCRAFT}/{path}": text.encode() for path, text in aircraft.items()},
    )
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    return {
        path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def test_recipe_writes_meshes_index_and_licences(debs: Path, tmp_path: Path) -> None:
    report = fetch_models(tmp_path / "out", debs)
    rows = list(csv.DictReader((tmp_path / "out/index.csv").open(encoding="utf-8")))
    assert [row["file"] for row in rows] == [
        "airplane/plane.ply",
        "chair/test-chair.ply",
        "table/test-table.ply",
    ]
    assert [row["author"] for row in rows] == ["B. Maker", "A. Maker", "A. Maker"]
    assert [row["licence"] for row in rows] == ["GPL-2+", "Free Art License 1.3", "CC0"]
    assert {row["version"] for row in rows} == {"1:2.0-1"} and rows[1][
        "source"
    ] == "Test.sh3f!/m/chair.obj"
    reasons = {source.rpartition("/")[2]: reason for source, reason in report.dropped.items()}
    assert reasons.pop("copy.obj") == "near-duplicate of chair/test-chair (surface IoU 1.000)"
    assert reasons.pop("tall.obj").startswith("stretched near-duplicate of chair/test-chair")
    assert reasons.keys() == {"broken.obj", "lost.obj", "odd.dae"}
    assert (
        "chair        1 meshes\n" in report.summary()
        and "\n1 skipped: near-duplicate" in report.summary()
    )
    assert (tmp_path / "out/licences/sweethome3d-furniture.copyright").read_bytes() == b"Free-Art"
    for row in rows:
        mesh = trimesh.load(tmp_path / "out" / row["file"], process=False)
        assert (len(mesh.vertices), len(mesh.faces)) == (int(row["vertices"]), int(row["faces"]))
        assert mesh.extents.max() == pytest.approx(1, abs=1e-6)
        np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0, atol=1e-6)
        assert mesh.is_watertight == (row["watertight"] == "True")
    fetch_models(tmp_path / "again", debs)
    assert contents(tmp_path / "again") == contents(tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again", "debs", "out"]


def test_airplane_faces_front_without_its_disc(debs: Path, tmp_path: Path) -> None:
    fetch_models(tmp_path / "out", debs)
    mesh = trimesh.load(tmp_path / "out/airplane/plane.ply", process=False)
    # the fin is at the tail: the nose is towards +z
    assert mesh.vertices[mesh.vertices[:, 1].argmax(), 2] < -0.3
    assert mesh.vertices[mesh.vertices[:, 1].argmin(), 0] > 0.3  # the left wing is at +x
    np.testing.assert_allclose(mesh.extents, [0.8, 0.4, 1.0], atol=1e-6)  # with the disc 0.801 in z


def test_script(debs: Path, tmp_path: Path) -> None:
    script = Path(fetch.__file__)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONSAFEPATH"}
    command = [sys.executable, script, "--output", "out", "--packages-dir", debs]
    run = partial(
        subprocess.run, command, cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    done = run()
    assert done.returncode == 0, done.stderr
    assert "chair        1 meshes\n" in done.stdout
    assert (tmp_path / "out/table/test-table.ply").exists()
    done = run()
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ") and "already exists" in done.stderr


def test_requests_that_are_refused_leave_nothing_behind(debs: Path, tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(ValueError, match="already exists"):
        fetch_models(tmp_path / "there", debs)
    file = next(debs.glob("flightgear*"))
    for content in (b"", b"!<arch>\n", file.read_bytes()[:-200]):
        file.write_bytes(content)
        with pytest.raises(ValueError, match="cannot be read as a Debian package"):
            fetch_models(tmp_path / "out", debs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["debs", "there"]


def test_packages_are_downloaded_if_they_are_not_there(
    debs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    real = subprocess.run

    def run(command: list, **options: object) -> subprocess.CompletedProcess:
        if command[0] != "apt-get":
            return real(command, **options)
        if command[-1] in missing:
            return subprocess.CompletedProcess(command, 100, "", "E: Unable to locate package p\n")
        shutil.copy(next(debs.glob(f"{command[-1]}_*")), options["cwd"])
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    missing = {"sweethome3d-furniture-nonfree"}
    report = fetch_models(tmp_path / "out", None)
    assert [model["title"] for model in report.models] == ["Plane plane", "Oak chair", "Table"]
    said = capsys.readouterr().err
    assert "Unable to locate package p" in said and "the component non-free" in said
    missing.add("flightgear-data-ai")
    with pytest.raises(ValueError, match="--packages-dir"):
        fetch_models(tmp_path / "other", None)


def test_clean_mesh_welds_and_drops() -> None:
    corners, quads = box((0, 0, 0), (2, 1, 1))
    vertices = np.concatenate([corners[cut(corners, quads).faces].reshape(-1, 3), [[99, 99, 99]]])
    mesh = clean_mesh(
        RawMesh(vertices, np.concatenate([np.arange(36).reshape(-1, 3), [[0, 0, 1]], [[2, 1, 0]]]))
    )
    assert (mesh.vertices.shape, mesh.faces.shape, mesh.is_watertight) == ((8, 3), (12, 3), True)
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -0.25, -0.25], [0.5, 0.25, 0.25]], atol=1e-12)
    for corner, message in (((2, 0, 0), "no face has an area"), ((0, 1, 0), "flat")):
        with pytest.raises(ValueError, match=message):
            clean_mesh(
                RawMesh(np.array([[0, 0, 0], [1, 0, 0], corner], float), np.array([[0, 1, 2]]))
            )


def test_surface_grid_of_a_box() -> None:
    corners, quads = box((0, 0, 0), (2, 1.2, 0.8))
    faces = cut(corners, quads).faces
    shell = np.ones((8, 8, 8), bool)
    shell[1:-1, 1:-1, 1:-1] = False
    np.testing.assert_array_equal(surface_grid(corners / [2, 1.2, 0.8] - 0.5, faces, 8), shell)
    flat = surface_grid(corners / 2 - [0.5, 0.3, 0.2], faces, 8)
    assert [int(flat.any(axis=axes).sum()) for axes in ((1, 2), (0, 2), (0, 1))] == [8, 6, 4]


@pytest.mark.parametrize(
    ("name", "category"),
    [
        ("Winchester armchair", "chair"),
        ("Desk lamp", "lamp"),
        ("Bedside table", "cabinet"),
        ("Chest freezer", None),
        ("Futon couch", "sofa"),
        ("Opened sofa bed", None),
    ],
)
def test_furniture_category(name: str, category: str | None) -> None:
    assert furniture_category(name, "Living room") == category
    assert furniture_category(name, "Vehicles") is None


@pytest.mark.parametrize(
    ("path", "whole"),
    [
        ("A320/Models/A320.ac", True),
        ("Lightning/Models/lightning-f1a.ac", True),
        ("Lightning/Models/light-red-flare.ac", False),
        ("Plane/Models/Lights/Strobe.ac", False),
        ("Cessna208Caravan/Models/wheels.ac", False),
        ("Ferry/FerryBoat1.ac", False),
    ],
)
def test_airplane_files(path: str, whole: bool) -> None:
    assert (NOT_AIRPLANES.search(path) is None) == whole


def test_catalogue_text() -> None:
    general, entries = read_catalogue(
        "# x\nlicense=L\nempty=\nname#2=B\n name#1 = caf\\u00e9 = A\nmodel#1=/m\n"
    )
    assert general == {"license": "L", "empty": ""}
    assert entries == [{"name": "café = A", "model": "/m"}, {"name": "B"}]


def test_furniture_is_turned_and_stretched() -> None:
    vertices, turn = np.array([[0.0, 0, 0], [1, 2, 3]]), {"modelRotation": "0 0 1 0 1 0 -1 0 0"}
    np.testing.assert_allclose(place_furniture(vertices, turn)[1], [3, 2, -1])
    placed = place_furniture(vertices, turn | {"width": "6", "height": "1", "depth": "5"})
    np.testing.assert_allclose(placed[1], [6, 1, -5])


def part(low: tuple, high: tuple) -> RawMesh:
    return cut(*box(low, high))


def test_effects_are_found_by_shape() -> None:
    body = part((-5, 0, -5), (5, 1, 5))
    disc, fan = part((-5, -1, -1), (-4.99, 1, 1)), part((-5, -0.4, -0.4), (-4.99, 0.4, 0.4))
    blade, wing = part((-5, -1, -0.1), (-4.99, 1, 0.1)), part((-1, -0.01, -1), (1, 0, 1))
    square = np.array([[9.0, 0, 0], [9, 1, 0], [9, 1, 1], [9, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    vapour, twin = RawMesh(square, faces), RawMesh(square, faces[:, ::-1])
    panel = RawMesh(square - [4, 0, 0], faces)  # touches the body's edge
    panel.vertices[0] = [5, 0, 5]
    kept = remove_effects([body, disc, fan, blade, wing, vapour, twin, panel])
    assert [id(one) for one in kept] == [id(one) for one in (body, fan, blade, wing, panel)]


def test_ac3d_tree_names_and_transforms() -> None:
    child = ac_object("child", (0, 0, 0), (1, 1, 1)).replace("numvert", "loc 10 0 0\nnumvert")
    turned = (
        'OBJECT group\nname "g"\ndata 5\nkids9\nrot 0 1 0 -1 0 0 0 0 1\nloc 0 0 5\nkids 1\n' + child
    )
    blank = ac_object("blank", (0, 0, 0), (2, 2, 2)).replace("numsurf", "\nnumsurf")
    line = ac_object("line", (0, 0, 0), (1, 1, 1)).replace("0X30", "0x2")
    blur = (
        ac_object("Prop-Blur", (0, 0, 0), (1, 1, 1), "kids 1")
        + "\n"
        + ac_object("inner", (0, 0, 0), (1, 1, 1))
    )
    parts = read_ac3d(ac_text(turned, blank, line, blur), skip=lambda name: "Blur" in name)
    assert [one.vertices.max() for one in parts] == [11, 2]
    # row vectors: (x, y) -> (-y, x)
    np.testing.assert_allclose(parts[0].vertices.min(axis=0), [-1, 10, 5])
    assert len(parts[0].faces) == 12


@pytest.mark.parametrize("text", ["", "hello", ac_text(AIRPLANE[0])[:-40]])
def test_bad_ac3d(text: str) -> None:
    with pytest.raises(ValueError, match="AC3D"):
        read_ac3d(text, skip=lambda name: False)
