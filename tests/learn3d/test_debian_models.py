"""The Debian recipe on tiny packages made here: placement, class rules, effects, duplicates, refusals, errors."""

from __future__ import annotations

import csv
import io
import os
import subprocess
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from fuzz_meshes import deb_bytes
from memory_checks import at_most

from learn3d import limits
from learn3d.data import debian_packages as packages
from learn3d.data.debian_aircraft import is_airplane_file, turn_to_front, without_effects
from learn3d.data.debian_furniture import furniture_category, place_furniture, read_catalogue
from learn3d.data.debian_models import FetchConfig, fetch_debian_models
from learn3d.data.mesh_cleaning import clean_mesh, overlap, surface_grid
from learn3d.data.mesh_text import Part, read_ac3d, read_obj, triangulate, write_ply
from learn3d.data.meshes import is_watertight

CATALOGUE = "PluginFurnitureCatalog.properties"
AIRCRAFT = "usr/share/games/flightgear/AI/Aircraft"


def box(low: tuple, high: tuple) -> tuple[np.ndarray, list[list[int]]]:
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])], float
    )
    return corners, [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def obj_text(*boxes: tuple[tuple, tuple]) -> str:
    lines = []
    for number, (low, high) in enumerate(boxes):
        corners, quads = box(low, high)
        lines += [f"v {x} {y} {z}" for x, y, z in corners]
        lines += ["f " + " ".join(f"{8 * number + i + 1}/1/1" for i in quad) for quad in quads]
    return "\n".join(lines)


def ac_object(name: str, low: tuple, high: tuple, kids: str = "kids 0") -> str:
    corners, quads = box(low, high)
    lines = ["OBJECT poly", f'name "{name}"', f"numvert {len(corners)}"]
    lines += [f"{x} {y} {z}" for x, y, z in corners]
    lines.append(f"numsurf {len(quads)}")
    for quad in quads:
        lines += ["SURF 0X30", "mat 0", "refs 4", *(f"{i} 0 0" for i in quad)]
    return "\n".join([*lines, kids])


def ac_text(*objects: str) -> str:
    return "\n".join(["AC3Db", "OBJECT world", f"kids {len(objects)}", *objects])


# An airplane of boxes in FlightGear's frame: nose -x, y up, left wing +z; fin at the tail, left tip lower.
AIRPLANE = (
    ac_object("fuselage", (-5, 0, -0.5), (5, 1, 0.5)),
    ac_object("wing-left", (-1, 0, 0.5), (1, 0.2, 4)),
    ac_object("wing-right", (-1, 0, -4), (1, 0.2, -0.5)),
    ac_object("tip", (-0.5, -1, 3.5), (0.5, 0, 4)),
    ac_object("fin", (4, 1, -0.1), (5, 3, 0.1)),
)
CHAIR = obj_text(((0, 4, 0), (4, 5, 4)), ((0, 5, 0), (4, 10, 0.5)), ((0, 0, 0), (4, 4, 0.5)), ((0, 0, 3.5), (4, 4, 4)))
TABLE = obj_text(((0, 4, 0), (8, 5, 5)), ((3, 0, 2), (5, 4, 3)))


def deb(folder: Path, name: str, files: dict[str, bytes | None], version: str = "1%3a2.0-1") -> Path:
    """A package of these files; None makes a symbolic link that leads out of it."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:xz") as tar:
        for path, content in files.items():
            info = tarfile.TarInfo(path)
            if content is None:
                info.type, info.linkname = tarfile.SYMTYPE, "/etc/hostname"
                tar.addfile(info)
            else:
                info.size = len(content)
                tar.addfile(info, io.BytesIO(content))
    folder.mkdir(exist_ok=True)
    file = folder / f"{name}_{version}_all.deb"
    with file.open("wb") as out:
        out.write(b"!<arch>\n")
        for member, content in (
            ("debian-binary", b"2.0\n"),
            ("control.tar.xz", b"odd"),
            ("data.tar.xz", data.getvalue()),
        ):
            out.write(f"{member:<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{len(content):<10}`\n".encode())
            out.write(content + b"\n" * (len(content) % 2))
    return file


def catalogue(entries: list[dict], models: dict[str, str]) -> bytes:
    lines = ["id=Test#Models", "license=Free Art License 1.3"]
    for number, entry in enumerate(entries, 1):
        lines += [f"{key}#{number}={value}" for key, value in entry.items()]
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr(CATALOGUE, "\n".join(lines))
        for path, text in models.items():
            archive.writestr(path, text)
    return data.getvalue()


def entry(name: str, stem: str, **more: str) -> dict:
    return {"name": name, "category": "Living room", "model": f"/m/{stem}.obj", "creator": "A. Maker", **more}


@pytest.fixture
def debs(tmp_path: Path) -> Path:
    """A catalogue with a chair, its copy, a stretched copy, a table, a cup; an airplane, a light and a balloon."""
    entries = [
        entry("Oak chair", "chair"),
        entry("Red chair", "copy"),
        entry("Tall chair", "chair", width="4", height="30", depth="4"),
        entry("Table", "table", license="CC0"),
        entry("Cup", "cup"),
        entry("Broken table", "broken"),
        entry("Odd sofa", "odd", model="/m/odd.dae"),
    ]
    models = {"m/chair.obj": CHAIR, "m/copy.obj": CHAIR, "m/table.obj": TABLE, "m/broken.obj": "v 0 0 0\nf 1 2 3"}
    folder = tmp_path / "debs"
    sh3f = {"./usr/share/sweethome3d/furniture/Test.sh3f": catalogue(entries, models)}
    notice = {"./usr/share/doc/sweethome3d-furniture/copyright": b"Free-Art"}
    deb(folder, "sweethome3d-furniture", {**sh3f, **notice})
    disc = ac_object("thing", (-5.01, -1, -1), (-5, 1, 1))
    aircraft = {
        "Plane/plane-main.xml": "<author>B. Maker</author><path>Models/plane.ac</path>",
        "Plane/Models/plane.ac": ac_text(*AIRPLANE, disc),
        "Plane/Models/lights/RedLight.ac": ac_text(AIRPLANE[0]),
        "balloon/Models/balloon1.ac": ac_text(AIRPLANE[0]),
    }
    files: dict[str, bytes | None] = {f"./{AIRCRAFT}/{path}": text.encode() for path, text in aircraft.items()}
    deb(folder, "flightgear-data-ai", {**files, f"./{AIRCRAFT}/Plane/Models/link.ac": None})
    return folder


def fetch(folder: Path, debs: Path | None, **more):
    return fetch_debian_models(FetchConfig(output=folder, packages_dir=debs, progress=False, **more))


# ---------------------------------------------------------------- the whole recipe


def test_recipe_writes_meshes_index_and_reasons(debs: Path, tmp_path: Path):
    trimesh = pytest.importorskip("trimesh")
    report = fetch(tmp_path / "out", debs)
    rows = list(csv.DictReader((tmp_path / "out/index.csv").open(encoding="utf-8")))
    assert [row["file"] for row in rows] == ["airplane/plane.ply", "chair/test-chair.ply", "table/test-table.ply"]
    assert [row["author"] for row in rows] == ["B. Maker", "A. Maker", "A. Maker"]
    assert [row["licence"] for row in rows] == ["GPL-2+", "Free Art License 1.3", "CC0"]
    assert {row["version"] for row in rows} == {"1:2.0-1"}
    assert rows[1]["source"] == "Test.sh3f!/m/chair.obj"
    reasons = {drop.title: drop.reason for drop in report.dropped}
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
    fetch(tmp_path / "out", debs, categories=("airplane",))
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
    report = fetch(tmp_path / "out", debs, categories=("chair",), duplicate_iou=1, stretched_iou=1)
    assert [model.file for model in report.models] == [
        "chair/test-chair-2.ply",
        "chair/test-chair.ply",
        "chair/test-copy.ply",
    ]


def test_installed_packages_are_read_below_root(tmp_path: Path):
    root = tmp_path / "root"
    path = f"{AIRCRAFT}/Plane/Models/plane.ac"
    (root / path).parent.mkdir(parents=True)
    (root / path).write_text(ac_text(*AIRPLANE))
    (root / path).with_name("plane2.ac").symlink_to("plane.ac")
    info = root / "var/lib/dpkg/info"
    info.mkdir(parents=True)
    listed = [f"/{path}", f"/{path}".replace("plane.ac", "plane2.ac"), "/usr/share"]
    (info / "flightgear-data-ai.list").write_text("\n".join(listed))
    (root / "var/lib/dpkg/status").write_text(
        "Package: other\nVersion: 9\n\nPackage: flightgear-data-ai\nVersion: 1:7-1\n"
    )
    config = FetchConfig(tmp_path / "out", ("airplane",), root=root, progress=False)
    report = fetch_debian_models(config)
    (model,) = report.models
    assert not report.dropped  # the symbolic link was not followed, so there is no duplicate
    assert (model.version, model.source) == ("1:7-1", path)
    with pytest.raises(ValueError, match="sweethome3d-furniture is not installed below"):
        fetch_debian_models(FetchConfig(tmp_path / "out2", root=root, progress=False))


def test_output_is_replaced_only_when_asked_and_ours(debs: Path, tmp_path: Path):
    out = tmp_path / "out"
    fetch(out, debs, categories=("chair",))
    with pytest.raises(ValueError, match="--overwrite"):
        fetch(out, debs)
    fetch(out, debs, categories=("table",), overwrite=True)
    assert sorted(path.name for path in out.iterdir()) == ["dropped.csv", "index.csv", "licences", "table"]
    (tmp_path / "precious").mkdir()
    with pytest.raises(ValueError, match="not written by this tool"):
        fetch(tmp_path / "precious", debs, overwrite=True)


def test_a_failure_leaves_nothing_behind(debs: Path, tmp_path: Path):
    deb(debs, "sweethome3d-furniture", {"usr/share/x.sh3f": b"no zip"})  # same name and version: replaces the good one
    with pytest.raises(ValueError, match=r"x\.sh3f is refused as a zip archive"):
        fetch(tmp_path / "out", debs)
    assert [path.name for path in tmp_path.iterdir()] == ["debs"]


# ---------------------------------------------------------------- packages


def test_unsafe_members_are_refused(debs: Path, tmp_path: Path):
    deb(debs, "sweethome3d-furniture", {"../../evil.sh3f": b""})
    with pytest.raises(ValueError, match=r"refused: its member '\.\./\.\./evil\.sh3f' points outside"):
        fetch(tmp_path / "out", debs)
    sh3f = catalogue([entry("Chair", "chair")], {"m/../../evil.obj": CHAIR})
    deb(debs, "sweethome3d-furniture", {"usr/Test.sh3f": sh3f})
    with pytest.raises(ValueError, match=r"Test\.sh3f is refused"):
        fetch(tmp_path / "out", debs)


def test_oversized_members_are_refused(debs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(limits, "PACKAGE_FILE_BYTES", 100)
    with pytest.raises(ValueError, match=r"bytes, at most 100 are read"):
        fetch(tmp_path / "out", debs)
    with zipfile.ZipFile(io.BytesIO(), "w") as archive:
        archive.writestr("m", b"x")
        archive.getinfo("m").file_size = limits.CATALOGUE_MEMBER_BYTES + 1
        with pytest.raises(ValueError, match="refused"):
            packages.read_member(archive, "m")


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "not a Debian package"), (b"!<arch>\n", "no data.tar"), (None, "cannot be read as a Debian package")],
)
def test_damaged_packages(debs: Path, tmp_path: Path, content: bytes | None, message: str):
    file = next(debs.glob("flightgear*"))
    file.write_bytes(file.read_bytes()[:-200] if content is None else content)
    with pytest.raises(ValueError, match=message):
        fetch(tmp_path / "out", debs, categories=("airplane",))


def test_missing_and_doubled_packages(debs: Path, tmp_path: Path):
    deb(debs, "flightgear-data-ai", {}, version="3")
    with pytest.raises(ValueError, match="several versions of flightgear-data-ai"):
        fetch(tmp_path / "out", debs)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="apt-get download sweethome3d-furniture"):
        fetch(tmp_path / "out", tmp_path / "empty")


def test_download_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(packages.shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match="--packages-dir"):
        fetch(tmp_path / "out", None)
    monkeypatch.setattr(packages.shutil, "which", lambda name: name)
    answer = subprocess.CompletedProcess([], 100, "", "W: x\nE: Unable to locate package p\n")
    monkeypatch.setattr(packages.subprocess, "run", lambda *args, **kwargs: answer)
    with pytest.raises(ValueError, match=r"\(Unable to locate package p\); run `apt-get update` as root first"):
        fetch(tmp_path / "out", None)
    with pytest.raises(packages.PackageMissing, match="non-free"):
        packages.download_package("sweethome3d-furniture-nonfree", tmp_path)


def test_download_finds_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def run(command, cwd, **kwargs):
        deb(cwd, command[-1], {})
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(packages.shutil, "which", lambda name: name)
    monkeypatch.setattr(packages.subprocess, "run", run)
    assert packages.download_package("flightgear-data-ai", tmp_path).version == "1:2.0-1"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"categories": ("car",)}, "got car"),
        ({"categories": ()}, "got none"),
        ({"root": Path("/")}, "not both"),
        ({"duplicate_iou": 0}, r"duplicate_iou must be in \(0, 1\]"),
    ],
)
def test_bad_config(debs: Path, tmp_path: Path, more: dict, message: str):
    with pytest.raises(ValueError, match=message):
        fetch(tmp_path / "out", debs, **more)


# ---------------------------------------------------------------- furniture


@pytest.mark.parametrize(
    ("name", "category"),
    [
        ("Winchester armchair", "chair"),
        ("Bar stool", "chair"),
        ("Class seat", "chair"),
        ("Wheelchair", None),
        ("Chair with cushion", "chair"),
        ("Round table", "table"),
        ("Table fan", None),
        ("Table tennis bat", None),
        ("Tablet", None),
        ("Computer desk", "table"),
        ("Desk lamp", "lamp"),
        ("Wall light", "lamp"),
        ("Light switch", None),
        ("Candle", None),
        ("Bedside table", "cabinet"),
        ("Chest freezer", None),
        ("Angle shelf 160", "cabinet"),
        ("Blue corner shelf", None),
        ("Towel rack", None),
        ("Washbasin with cabinet", None),
        ("Futon couch", "sofa"),
        ("Opened sofa bed", None),
        ("Toilets unit", None),
    ],
)
def test_category_by_name(name: str, category: str | None):
    assert furniture_category(name, "Living room") == category


def test_category_by_section():
    assert furniture_category("Chair lift", "Vehicles") is None


def test_catalogue_text():
    general, entries = read_catalogue("# x\nlicense=L\nname#2=B\n name#1 = caf\\u00e9 = A\nmodel#1=/m\n")
    assert general == {"license": "L"}
    assert entries == [{"name": "café = A", "model": "/m"}, {"name": "B"}]


def test_furniture_is_turned_and_stretched():
    vertices = np.array([[0.0, 0, 0], [1, 2, 3]])
    turned = place_furniture(vertices, {"modelRotation": "0 0 1 0 1 0 -1 0 0"})
    np.testing.assert_allclose(turned[1], [3, 2, -1])
    placed = place_furniture(
        vertices, {"modelRotation": "0 0 1 0 1 0 -1 0 0", "width": "6", "height": "1", "depth": "5"}
    )
    np.testing.assert_allclose(placed[1], [6, 1, -5])


@pytest.mark.parametrize("rotation", ["1 0 0", "1 0 0 0 1 0 0 0 -1", "2 0 0 0 1 0 0 0 1"])
def test_bad_rotation(rotation: str):
    with pytest.raises(ValueError, match="modelRotation is not a rotation"):
        place_furniture(np.eye(3), {"modelRotation": rotation})


# ---------------------------------------------------------------- aircraft


@pytest.mark.parametrize(
    ("path", "whole"),
    [
        ("A320/Models/A320.ac", True),
        ("Lightning/Models/lightning-f1a.ac", True),
        ("Lightning/Models/light-red-flare.ac", False),
        ("Plane/Models/Lights/Strobe.ac", False),
        ("Plane/Models/refueling/plane.ac", False),
        ("c182/Models/toggle-white.ac", False),
        ("Cessna208Caravan/Models/wheels.ac", False),
        ("balloon/Models/tuxalloon.ac", False),
        ("Ferry/FerryBoat1.ac", False),
        ("c172/Models/c172p.ac", True),
    ],
)
def test_airplane_files(path: str, whole: bool):
    assert is_airplane_file(path) == whole


def test_turn_to_front_is_a_rotation():
    nose_up_left = turn_to_front(np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]]))
    np.testing.assert_array_equal(nose_up_left, [[0, 0, 1], [0, 1, 0], [1, 0, 0]])


def part(name: str, low: tuple, high: tuple) -> Part:
    corners, quads = box(low, high)
    return Part(name, corners, triangulate(quads, corners))


def test_effects_are_found_by_shape():
    body = part("body", (-5, 0, -5), (5, 1, 5))
    disc, fan = part("a", (-5, -1, -1), (-4.99, 1, 1)), part("b", (-5, -0.4, -0.4), (-4.99, 0.4, 0.4))
    blade, wing = part("c", (-5, -1, -0.1), (-4.99, 1, 0.1)), part("d", (-1, -0.01, -1), (1, 0, 1))
    square = np.array([[9.0, 0, 0], [9, 1, 0], [9, 1, 1], [9, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    vapour, twin = Part("e", square, faces), Part("f", square, faces[:, ::-1])
    panel = Part("g", square - [4, 0, 0], faces)  # touches the body's edge
    panel.vertices[0] = [5, 0, 5]
    kept = without_effects([body, disc, fan, blade, wing, vapour, twin, panel])
    assert [one.name for one in kept] == ["body", "b", "c", "d", "g"]


def test_ac3d_tree_names_and_transforms():
    child = ac_object("child", (0, 0, 0), (1, 1, 1)).replace("numvert", "loc 10 0 0\nnumvert")
    turned = 'OBJECT group\nname "g"\ndata 5\nkids9\nrot 0 1 0 -1 0 0 0 0 1\nloc 0 0 5\nkids 1\n' + child
    blank = ac_object("blank", (0, 0, 0), (1, 1, 1)).replace("numsurf", "\nnumsurf")
    line = ac_object("line", (0, 0, 0), (1, 1, 1)).replace("0X30", "0x2")
    blur = ac_object("Prop-Blur", (0, 0, 0), (1, 1, 1), "kids 1") + "\n" + ac_object("inner", (0, 0, 0), (1, 1, 1))
    parts = read_ac3d(ac_text(turned, blank, line, blur), skip=lambda name: "Blur" in name)
    assert [one.name for one in parts] == ["child", "blank"]
    np.testing.assert_allclose(parts[0].vertices.min(axis=0), [-1, 10, 5])  # row vectors: (x, y) -> (-y, x)
    assert len(parts[0].faces) == 12


@pytest.mark.parametrize("text", ["", "hello", ac_text(AIRPLANE[0])[:-40]])
def test_bad_ac3d(text: str):
    with pytest.raises(ValueError, match="AC3D"):
        read_ac3d(text)


# ---------------------------------------------------------------- meshes


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("start", range(6))
def test_concave_polygons_keep_their_area(start: int):
    arrow = np.roll([[0, 0], [4, 0], [1, 1], [0, 4]], start, axis=0)
    ell = np.roll([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]], start, axis=0)
    for outline, expected in ((arrow, 4.0), (ell, 5.0), (ell[::-1], 5.0)):
        vertices = np.column_stack([outline, outline[:, 0]]).astype(float)  # in the plane z = x
        faces = triangulate([list(range(len(outline)))], vertices)
        assert len(faces) == len(outline) - 2
        assert area(vertices, faces) == pytest.approx(expected * np.sqrt(2))
        before = np.cross(vertices, np.roll(vertices, -1, axis=0)).sum(axis=0)
        after = np.cross(vertices[faces[0, 1]] - vertices[faces[0, 0]], vertices[faces[0, 2]] - vertices[faces[0, 0]])
        assert before @ after > 0  # the winding stays


def test_obj_text():
    vertices, faces = read_obj("# c\nv 0 0 0\nv 1 0 0 1 1 1\nv 0 1 \\\n 0\ng x\nf 1/2/3 -2//1 3\nf 1 2\nl 1 2\n")
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(faces, [[0, 1, 2]])
    with pytest.raises(ValueError, match="three numbers"):
        read_obj("v 0 0\nv 1 2 3")
    with pytest.raises(ValueError, match="names vertex 3, but there are 1"):
        read_obj("v 0 0 0\nf 1 2 4")


def test_clean_mesh_welds_and_drops():
    corners, quads = box((0, 0, 0), (2, 1, 1))
    soup = triangulate(quads, corners)
    vertices = np.concatenate([corners[soup].reshape(-1, 3), [[99, 99, 99]]])
    faces = np.concatenate([np.arange(36).reshape(-1, 3), [[0, 0, 1]], [[2, 1, 0]]])
    points, clean = clean_mesh(vertices, faces)
    assert (points.shape, clean.shape) == ((8, 3), (12, 3))
    assert is_watertight(points, clean) and not is_watertight(points, clean[1:])
    np.testing.assert_allclose(np.ptp(points, axis=0), [1, 0.5, 0.5])
    np.testing.assert_allclose(points.min(axis=0) + points.max(axis=0), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("vertices", "message"),
    [
        (np.zeros((3, 3)), "single point"),
        (np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2.0]]), "no face has an area"),
        (np.array([[0, 0, 0], [1, 0, 0], [0, 1.0, 0]]), "flat"),
        (np.array([[0, 0, 0], [np.nan, 0, 0], [0, 1.0, 0]]), "not finite"),
    ],
)
def test_clean_mesh_refuses(vertices: np.ndarray, message: str):
    with pytest.raises(ValueError, match=message):
        clean_mesh(vertices, np.array([[0, 1, 2]]))


def test_surface_grid_of_a_box():
    corners, quads = box((0, 0, 0), (2, 1.2, 0.8))
    faces = triangulate(quads, corners)
    cube = surface_grid(corners, faces, 8, per_axis=True)
    shell = np.ones((8, 8, 8), bool)
    shell[1:-1, 1:-1, 1:-1] = False
    np.testing.assert_array_equal(cube, shell)
    flat = surface_grid(corners, faces, 8)
    assert [int(flat.any(axis=axes).sum()) for axes in ((1, 2), (0, 2), (0, 1))] == [8, 6, 4]
    assert overlap(cube, cube) == 1 and overlap(cube, flat) < 0.5


def test_ply_reads_back(tmp_path: Path):
    trimesh = pytest.importorskip("trimesh")
    corners, quads = box((0, 0, 0), (2, 1, 1))
    faces = triangulate(quads, corners)
    write_ply(tmp_path / "box.ply", corners, faces)
    mesh = trimesh.load(tmp_path / "box.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, corners)
    np.testing.assert_array_equal(mesh.faces, faces)
    assert [path.name for path in tmp_path.iterdir()] == ["box.ply"]


def test_archives_that_lead_astray_are_refused(debs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refused(message: str) -> None:
        with pytest.raises(ValueError, match=message):
            fetch(tmp_path / "out", debs, categories=("chair",))

    file = deb(debs, "sweethome3d-furniture", {"usr/x.sh3f": catalogue([], {})})
    content = file.read_bytes()
    at = content.index(b"control.tar")
    for size in (b"-60       ", b"1e9       ", b"          "):  # the first would be read for ever
        file.write_bytes(content[: at + 48] + size + content[at + 58 :])
        refused("its member 'control.tar.xz' has no size")
    file.write_bytes(content)
    monkeypatch.setattr(limits, "PACKAGE_MEMBERS", 0)
    refused("it has more than 0 members")
    monkeypatch.undo()
    monkeypatch.setattr(limits, "PACKAGE_BYTES", 5000)
    refused("unpacks to more than its headers say, or than 5000 bytes")
    monkeypatch.undo()
    monkeypatch.setattr(limits, "PACKAGE_WANTED_BYTES", 50)
    refused("sweethome3d-furniture is refused: its files .sh3f have more than 50 bytes")
    if hasattr(os, "mkfifo"):
        file.unlink()
        os.mkfifo(file)
        refused("it is no plain file; expected a Debian package")


def test_long_names_and_gaps_take_no_square_of_their_length(debs: Path, tmp_path: Path):
    """The square of a million takes hours."""
    assert furniture_category("chair") == "chair" and furniture_category("chair " + "knife " * 10**6) is None
    name = "prop" * 10**6
    text = ac_text(ac_object(name, (-5, 0, -0.5), (5, 1, 0.5)), *AIRPLANE)
    about = f"<author>B. Maker</author><path>{' ' * 10**6}x</path><path> Models/plane.ac\n</path>"
    files = {f"./{AIRCRAFT}/Plane/Models/plane.ac": text.encode(), f"./{AIRCRAFT}/Plane/plane.xml": about.encode()}
    deb(debs, "flightgear-data-ai", files)
    report = fetch(tmp_path / "out", debs, categories=("airplane",))
    assert [(model.title, model.author) for model in report.models] == [("Plane plane", "B. Maker")]


def test_a_tar_header_that_unpacks_to_very_much_is_not_kept(debs: Path, tmp_path: Path):
    """A long name of 100 MB takes 15 kB in the package, and tarfile would hold all of it."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:xz", format=tarfile.GNU_FORMAT) as tar:
        tar.addfile(tarfile.TarInfo("n" * 100_000_000))
    file = deb(debs, "sweethome3d-furniture", {})
    content = file.read_bytes()
    start, packed = content.index(b"data.tar"), data.getvalue()
    file.write_bytes(content[:start] + f"{'data.tar.xz':<48}{len(packed):<10}`\n".encode() + packed)
    assert len(packed) < 100_000
    with at_most(2**25), pytest.raises(ValueError, match="unpacks to more than its headers say"):
        fetch(tmp_path / "out", debs, categories=("chair",))


@pytest.mark.parametrize("kind", ["gz", "bz2", "xz"])
def test_packages_of_every_compression_are_read(tmp_path: Path, kind: str):
    (tmp_path / "p_1_all.deb").write_bytes(deb_bytes({"usr/a.ac": b"1" * 30_000, "usr/b.ac": b"2"}, kind))
    found = dict(packages.read_package(packages.find_package("p", tmp_path), (".ac",)))
    assert found == {"usr/a.ac": b"1" * 30_000, "usr/b.ac": b"2"}


TEXTS = {
    "a vertex beyond any": ("v 0 0 0\nf 1 1 " + "9" * 400, "names vertex 9999"),
    "a vertex before any": ("v 0 0 0\nf 1 1 -9", "names vertex -8"),
    "many corners": ("v 0 0 0\nf" + " 1" * 2001, "a polygon has 2001 corners; at most 2000 are read"),
    "no number": ("f 1 2 x", "invalid literal"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_obj_texts_that_cannot_be(name: str):
    text, message = TEXTS[name]
    with pytest.raises(ValueError, match=message):
        read_obj(text)


def test_ac3d_polygons_without_a_kind_are_left_out():
    assert read_ac3d("AC3Db\nOBJECT poly\nnumvert 1\n0 0 0\nrefs 3\n0 0 0\n0 0 0\n0 0 0\nkids 0") == []
    with pytest.raises(ValueError, match="ends in the middle"):
        read_ac3d("AC3Db\nOBJECT poly\nnumvert 99999999999\n0 0 0")


def test_names_that_are_no_characters_and_numbers_that_are_none():
    _, entries = read_catalogue("name#1=half \\ud83d a pair\nname#" + "9" * 5000 + "=x\nname#2=ok")
    assert [e["name"] for e in entries] == ["half ? a pair", "ok"]


def test_large_faces_are_sampled_piece_by_piece():
    rng = np.random.default_rng(0)
    vertices = rng.uniform(-0.5, 0.5, (600, 3))
    with at_most(2**28):
        grid = surface_grid(vertices, np.arange(600).reshape(-1, 3), 64)
    assert grid.mean() > 0.1
