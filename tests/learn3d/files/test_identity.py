"""Random folders of meshes and photographs: each object once, and everything that is left out is said.

FOLDERS=200 in the environment makes more of them than the usual few.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from learn3d.data.layouts import check_folder
from learn3d.data.readers import photos
from learn3d.files.identity import describe, find_equal, find_files, measure, one_format
from learn3d.studio.make_data.meshes import DatasetConfig, find_meshes, split_items

FOLDERS = int(os.environ.get("FOLDERS", "6"))


def random_folder(folder: Path, rng: np.random.Generator) -> tuple[set[str], int]:
    """A folder of boxes. Returns the names of its objects without ending, and how many other names of files and linked
    folders it has."""
    outside = folder.with_name(f"{folder.name} outside")
    outside.mkdir()
    folder.mkdir()
    objects, others = set(), 0
    for number in range(rng.integers(3, 9)):
        place = str(rng.choice(["", "a/", "a/b c/", "Stühle/"]))
        name, first = f"{place}box {number}.x", folder / f"{place}box {number}.x.obj"
        first.parent.mkdir(parents=True, exist_ok=True)
        box = trimesh.creation.box((1, 0.2 + 0.05 * number, 0.4))
        box.export(first)
        objects.add(name)
        kind = rng.integers(10)
        if kind == 0:  # other formats
            box.export(first.with_suffix(".glb"))
            box.export(first.with_suffix(".STL"), file_type="stl")
            others += 2
        elif kind == 1:  # a copy, the same box turned into more triangles, and one of another scale
            shutil.copy(first, folder / f"zz copy {number}.obj")
            box.subdivide().export(folder / f"zz fine {number}.ply")
            trimesh.Trimesh(7 * box.vertices + 3, box.faces).export(folder / f"zz {number}.off")
            others += 3
        elif kind == 2:  # written by systems
            (first.parent / f"._{first.name}").write_bytes(b"\0\5\26\7")
            (folder / "__MACOSX" / place).mkdir(parents=True, exist_ok=True)
            (folder / "__MACOSX" / place / f"._{first.name}").write_bytes(b"\0\5\26\7")
            others += 1
        elif kind == 3:  # the object is a link to a file
            first.rename(outside / f"{number}.obj")
            first.symlink_to(outside / f"{number}.obj")
        elif kind == 4:  # the object's folder is a link
            (outside / f"{number}").mkdir()
            first.rename(outside / f"{number}" / "model.obj")
            (folder / f"id {number}").symlink_to(outside / f"{number}")
            objects.symmetric_difference_update({name, f"id {number}/model"})
        elif kind == 5:  # links to what is there: a file, a folder, the whole
            (folder / f"again {number}.obj").symlink_to(first)
            (folder / f"0 again {number}").symlink_to(first.parent)
            (first.parent / f"up {number}").symlink_to(folder)
            others += 3
        elif kind == 6:
            (folder / f"broken {number}.obj").symlink_to(folder / "nowhere.obj")
            (folder / f"notes {number}.txt").write_text("no mesh")
            others += 1
        elif kind == 7:  # of two formats the one that can be read counts
            box.export(first.with_suffix(".ply"))
            first.write_text("no mesh")
            others += 1
    others += (folder / "__MACOSX").exists()
    return objects, others


@pytest.mark.parametrize("seed", range(FOLDERS))
def test_each_object_of_a_folder_is_used_once(tmp_path: Path, seed: int) -> None:
    objects, others = random_folder(tmp_path / "boxes", np.random.default_rng(seed))
    found, left_out = find_meshes(tmp_path / "boxes")
    assert {name.rpartition(".")[0] for name in found} == objects
    assert not found.keys() & left_out.keys()
    assert len(left_out) == others, left_out
    assert all(len(read().faces) for read in found.values())
    said = describe(left_out)
    assert sum(int(line.split()[2]) for line in said) == others
    config = DatasetConfig(
        output=tmp_path, category="chair", source=tmp_path / "boxes", val=0, test=1
    )
    splits, again = split_items(config)
    assert sorted(item.file for items in splits.values() for item in items) == list(found)
    assert again == left_out


def test_equal_geometries_differ_in_less_than_a_ten_thousandth() -> None:
    ball, other = trimesh.creation.icosphere(3), trimesh.creation.icosphere(3)
    other.vertices[0] *= 1.01
    rounded = ball.vertices.round(6)
    meshes = {"a": ball.vertices, "b": other.vertices, "c": rounded, "d": 2 * other.vertices}
    measures = {name: measure(vertices, ball.faces) for name, vertices in meshes.items()}
    assert find_equal(measures) == {"c": "a", "d": "b"}
    areas = {"a": 1.0, "b": 1 - 1e-6, "c": 1 + 1e-6}
    alike = {name: np.full(13, area) for name, area in areas.items()}
    assert find_equal(alike) == {"b": "a", "c": "a"}, "the first of all"


def test_links_and_formats_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    for name in ("b/1.jpg", "b/1.png", "2.png", "Thumbs.db", ".x.png"):
        (tmp_path / name).write_bytes(name.encode())
    (tmp_path / "a.png").symlink_to("b/1.png")
    found, left_out = find_files(tmp_path)
    assert list(found) == ["2.png", "b/1.jpg", "b/1.png"]
    assert describe(left_out) == [
        "left out: 2 hidden files or folders, such as .x.png",
        "left out: 1 links to files or folders that are there already, such as a.png",
    ]
    assert one_format(["b/1.png", "2.png", "b/1.jpg"]) == (
        ["2.png", "b/1.png"],
        {"b/1.jpg": "other formats of an object"},
    )


def picture(path: Path, gray: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.zeros((70, 70, 4), np.uint8)
    pixels[10 : 40 + gray % 20, 20:50] = gray, gray, gray, 255
    Image.fromarray(pixels).save(path)


def write_table(folder: Path, names: list[str], azimuths: list[float]) -> list[str]:
    """Write poses.csv. Returns what check-dataset warns of."""
    lines = [
        f"{name},{azimuth},{20 + k},5.5,24"
        for k, (name, azimuth) in enumerate(zip(names, azimuths, strict=True))
    ]
    (folder / "poses.csv").write_text(
        "\n".join(["file,azimuth_deg,elevation_deg,distance,fov_deg", *lines])
    )
    reports = check_folder("photos", folder.parent, ["mug"], ["train", "val", "test"])
    assert not sum(report.count("error") for report in reports), reports
    return sorted({problem.message for report in reports for problem in report.problems})


def test_photographs_are_objects_by_their_relative_names(tmp_path: Path) -> None:
    folder = tmp_path / "mug"
    names = [f"{video}/{frame}.png" for video in "ab" for frame in range(3)] + ["a/0.webp"]
    for k, name in enumerate(names):
        picture(folder / "images" / name, 40 + k)
    said = write_table(
        folder, [name.replace("/", "\\") for name in names], [50.0 * k for k in range(7)]
    )
    sets = [photos.load(tmp_path, "mug", split) for split in ("train", "val", "test")]
    objects = {name for dataset in sets for name in dataset.object_names}
    assert objects == {"a/0.png", "a/0.webp", "a/1", "a/2", "b/0", "b/1", "b/2"}
    assert said == [
        "2 files share a name but for its ending, such as a/0.png; each is an object of its own",
        "each photograph in a folder is an object of its own; if a folder has photographs of one object, "
        "add a column object",
    ]
    mask = np.zeros((70, 70), np.uint8)
    mask[5:30, 5:30] = 255
    (folder / "masks" / "b").mkdir(parents=True)
    for name in ("b/1.png", "b/1.jpg", "1.png"):
        Image.fromarray(mask).save(folder / "masks" / name)
    rows = photos.read_photo_table(folder / "poses.csv", lambda found: None)
    assert [row.mask and row.mask.relative_to(folder).as_posix() for row in rows] == [
        *[None] * 4, "masks/b/1.png", *[None] * 2,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("azimuths", "message"),
    [
        (
            np.linspace(0, 6.2, 12),
            "azimuth_deg lies within 0 .. 6.2 in all 12 rows; is it in degrees",
        ),
        (np.full(12, 30.0), "all 12 rows have the azimuth 30; the back"),
        (np.linspace(-3.1, 3.1, 12) * 57, ""),
    ],
)
def test_angles_in_radians_and_without_a_turn_are_said(
    tmp_path: Path, azimuths: np.ndarray, message: str
) -> None:
    names = [f"{k}.png" for k in range(12)]
    for k, name in enumerate(names):
        picture(tmp_path / "mug" / "images" / name, 60 + k)
    said = write_table(tmp_path / "mug", names, azimuths.tolist())
    assert len(said) == bool(message) and all(message in each for each in said)


def test_a_picture_in_two_splits_is_said(tmp_path: Path) -> None:
    names = [f"{k}.png" for k in range(12)]
    for name in names:
        picture(tmp_path / "mug" / "images" / name, 60)
    said = write_table(tmp_path / "mug", names, [30.0 * k for k in range(12)])
    assert len(said) == 2 and all("is an object in both splits?" in each for each in said)
    assert "1 of the pictures of val are those of an object of train, such as" in said[0] + said[1]
