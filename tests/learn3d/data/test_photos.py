"""Your own photographs: the example's folder is read end to end, and every mistake in a table is named."""

from __future__ import annotations

import csv
import functools
import re
import runpy
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from learn3d.data.layouts import check_folder, load_dataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers import photos
from learn3d.data.readers.photos import split_objects
from learn3d.data.view_bins import choose_bins, view_classes
from learn3d.evaluation import evaluate
from learn3d.runs import checkpoint
from learn3d.training import train

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "make_photo_folder.py"
COLUMNS = ["file", "azimuth_deg", "elevation_deg", "distance", "fov_deg"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    return runpy.run_path(str(EXAMPLE))["main"](folder, "chair", objects=4, photos=3).parent


def test_the_best_networks_are_those_with_the_best_silhouettes(
    made: Path, tiny_names, tiny_config, read_metrics, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    summary = train(
        tiny_config(
            run,
            data=made,
            category="chair",
            layout="photos",
            learning_rate=0.01,
            iterations=3,
            validate_every=1,
            max_val_images=100,
        )
    )
    measured = {
        line["step"]: line["silhouette_iou"] for line in read_metrics(run) if line["split"] == "val"
    }
    best = summary.progress.best_step
    assert best == max(measured, key=measured.get)
    method, _, metadata = checkpoint.load_method(run / "best.safetensors")
    assert metadata.progress.step == best and measured[best] == summary.progress.best_iou
    again = evaluate(method, load_dataset("photos", made, "chair", "val")).values["silhouette_iou"]
    assert float(again.mean()) == pytest.approx(summary.progress.best_iou, abs=1e-5)


@pytest.fixture
def chairs(made: Path, tmp_path: Path) -> Path:
    """A copy to damage: the folder of the category."""
    return Path(shutil.copytree(made / "chair", tmp_path / "data" / "chair"))


def read_rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "poses.csv", newline="") as file:
        return list(csv.DictReader(file))


def change_rows(folder: Path, change: Callable[[dict[str, str]], dict[str, str | None]]) -> None:
    """Other entries in each row of the table; None takes an entry away."""
    rows = [row | change(row) for row in read_rows(folder)]
    write_rows(folder, [{k: v for k, v in row.items() if v is not None} for row in rows])


def write_rows(folder: Path, rows: list[dict[str, str]]) -> None:
    with open(folder / "poses.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)


def check(chairs: Path, severity: str) -> list[tuple[str, str]]:
    """(file, message) of all errors or warnings of the category."""
    found = dict.fromkeys(
        p for split in check_folder("photos", chairs.parent) for p in split.problems
    )
    return [(Path(p.path).name, p.message) for p in found if p.severity == severity]


def refused(chairs: Path, message: str, kind: type = ValueError, split: str = "train") -> None:
    """Loading and checking must say the message."""
    with pytest.raises(kind, match=message):
        photos.load(chairs.parent, "chair", split)
    assert any(re.search(message, f"{name}: {text}") for name, text in check(chairs, "error"))


def test_the_examples_folder_is_read(made: Path) -> None:
    sets = {split: photos.load(made, "chair", split) for split in ("train", "val", "test")}
    assert [(len(s), s.num_objects) for s in sets.values()] == [(6, 2), (3, 1), (3, 1)]
    # no object is in two splits
    assert len({name for s in sets.values() for name in s.object_names}) == 4
    train = sets["train"]
    assert train.voxels is None and train.masks is None
    assert train.inverted and train.image_size == 64
    assert all(s.view_names == train.view_names for s in sets.values())
    assert sorted(set(train.view_ids)) == list(range(train.num_views))
    row = next(row for row in read_rows(made / "chair") if row["object"] == train.object_names[0])
    assert float(train.poses.azimuth_deg[0]) == pytest.approx(float(row["azimuth_deg"]))
    assert float(train.poses.distance[0]) == pytest.approx(float(row["distance"]))
    assert float(train.poses.half_fov_deg[0]) == pytest.approx(float(row["fov_deg"]) / 2)
    assert (255 - train.images[0, :3, 0, 0]).tolist() == [255, 255, 255]
    large = photos.load(made, "chair", "val", image_size=224)
    assert large.images.shape == (3, 4, 224, 224) and large.masks.shape == (3, 64, 64)
    np.testing.assert_array_equal(large.masks, sets["val"].images[:, 3])
    found = [(s.split, s.objects, s.problems) for s in check_folder("photos", made)]
    assert found == [("train", 2, ()), ("val", 1, ()), ("test", 1, ())]
    assert len(load_dataset("photos", made, "chair", "train")) == 6
    assert load_dataset("photos", made, "chair", "train", view_bins="90x30:0:60").num_views == 8


@pytest.mark.parametrize(("delimiter", "encoding"), [(";", "utf-8"), (" , ", "utf-8-sig")])
def test_tables_of_other_programs_are_read(chairs: Path, delimiter: str, encoding: str) -> None:
    wanted = photos.load(chairs.parent, "chair", "train")
    table = chairs / "poses.csv"
    table.write_text(table.read_text().replace(",", delimiter), encoding)
    dataset = photos.load(chairs.parent, "chair", "train")
    np.testing.assert_array_equal(dataset.images, wanted.images)
    assert torch.equal(dataset.poses.azimuth_deg, wanted.poses.azimuth_deg)


def test_the_tables_own_splits_count(chairs: Path) -> None:
    first = read_rows(chairs)[0]["object"]
    change_rows(chairs, lambda row: {"split": "val" if row["object"] == first else "train"})
    assert photos.load(chairs.parent, "chair", "val").object_names == (first,)
    assert len(photos.load(chairs.parent, "chair", "train")) == 9
    with pytest.raises(ValueError, match=r"has no photograph for test; it has: train, val"):
        photos.load(chairs.parent, "chair", "test")


def test_photos_without_objects_are_objects_of_their_own(chairs: Path) -> None:
    change_rows(chairs, lambda row: {"object": None})
    sizes = [len(photos.load(chairs.parent, "chair", split)) for split in ("train", "val", "test")]
    assert sizes == [9, 1, 2]


def test_the_split_of_an_object_is_a_matter_of_its_name(made: Path) -> None:
    table = made / "chair" / "poses.csv"
    rows = [
        photos.Photo(k, Path(f"{k}.jpg"), None, f"object{k}", None, 0.0, 0.0, 3.0, 40.0)
        for k in range(200)
    ]
    one = split_objects(table, rows)
    assert [list(one.values()).count(split) for split in ("train", "val", "test")] == [140, 20, 40]
    assert split_objects(table, rows[::-1]) == one
    fewer = split_objects(table, rows[10:])
    assert sum(fewer[name] != one[name] for name in fewer) < 10
    chosen = [name for name, split in one.items() if split == "test"]
    assert chosen != sorted(one)[:40], "not those whose names come first"


@pytest.mark.parametrize(
    ("elevations", "azimuths", "count", "width", "rows"),
    [
        ((5.0, 45.0), (-180.0, 180.0), 60, 90, 2),
        ((5.0, 45.0), (-180.0, 180.0), 2000, 15, 2),
        ((-20.0, 40.0), (-180.0, 180.0), 300, 30, 3),
        ((30.0, 30.0), (-30.0, 30.0), 60, 15, 1),
    ],
)
def test_default_view_classes_suit_the_photos(elevations, azimuths, count, width, rows) -> None:
    rng = np.random.default_rng(0)
    poses = LookAtPoses(rng.uniform(*azimuths, count), rng.uniform(*elevations, count), 3.0, 20.0)
    bins = choose_bins(poses)
    assert bins.azimuth_width_deg == width and bins.shape[1] == rows
    assert bins.elevation_low_deg <= elevations[0] + 1
    assert bins.elevation_high_deg >= elevations[1] - 1


def test_a_direction_without_training_photos_gets_the_nearest_class() -> None:
    training, other = (
        LookAtPoses(torch.tensor(azimuths), 20.0, 3.0, 20.0)
        for azimuths in ([0.0] * 8 + [100.0] * 8, [1.0, 140.0, -60.0, -100.0])
    )
    ids, names = view_classes(other, training)
    assert len(names) == 2 and ids.tolist() == [0, 1, 0, 0]


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("azimuth_deg", "12,5", "azimuth_deg must be a valid number, .* got '12,5'"),
        ("fov_deg", "nan", "fov_deg must be a finite number, got 'nan'"),
        ("elevation_deg", "90", "elevation_deg must be less than 90, got '90'"),
        ("distance", "0.3", "distance must be greater than 0.5, got '0.3'"),
        ("split", "training", "split must be .*'train', 'val' or 'test', got 'training'"),
        ("file", "", "it must name a file in images/, got ''"),
        ("file", "../secret.png", "it must name a file in images/, got '../secret.png'"),
        ("file", "/etc/passwd", "it must name a file in images/, got '/etc/passwd'"),
        ("file", "chair000_0.jpg", "chair000_0.jpg is in two lines"),
        ("fov_deg", "x" * 100_000, "fov_deg must be a valid number, .* got 'x{100,300}"),
    ],
    ids=range(10),
)
def test_mistakes_in_a_row_are_named(chairs: Path, column: str, value: str, message: str) -> None:
    rows = read_rows(chairs)
    rows[4][column] = value
    write_rows(chairs, rows)
    refused(chairs, rf"poses.csv: line 6: {message}.{{0,3}}$")


def test_all_mistakes_are_listed(chairs: Path) -> None:
    rows = read_rows(chairs)
    rows[1]["distance"], rows[3]["fov_deg"] = "far", "0"
    write_rows(chairs, rows)
    assert [text.split(":")[0] for _, text in check(chairs, "error")] == ["line 3", "line 5"]


def test_photographs_without_poses_learn_from_an_estimate(
    chairs: Path, command, tiny_names, tiny_config, tmp_path: Path
) -> None:
    """A table without numbers keeps objects together; without any table each photograph is of another object."""
    write_rows(chairs, [{k: row[k] for k in ("file", "object")} for row in read_rows(chairs)])
    assert photos.load(chairs.parent, "chair", "train").num_objects == 2
    (chairs / "poses.csv").unlink()
    assert photos.load(chairs.parent, "chair", "train").poses is None
    assert {text.split(":")[0] for _, text in check(chairs, "warning")} == {"has no poses"}
    table = tmp_path / "poses.npz"
    options = ["--steps", "2", "--restarts", "1", "--prototypes", "2"]
    where = ["estimate-poses", chairs.parent, "--category", "chair", "--layout", "photos"]
    status, out, said = command(*where, "--output", table, *options, "--compare")
    assert status != 0 and "needs true poses" in said and "mean confidence" not in out
    status, _, said = command(*where, "--output", table, *options)
    assert status == 0, said
    assert "has no poses" not in said
    assert table.with_suffix(".png").is_file()
    about = {"data": chairs.parent, "category": "chair", "layout": "photos", "poses": table}
    assert train(tiny_config(tmp_path / "run", **about, iterations=1)).finished
    for path in (chairs / "images").iterdir():
        path.unlink()
    refused(chairs, "images: is empty; expected photographs")


def test_categories_with_poses_of_their_own_are_joined_by_common_classes(chairs: Path) -> None:
    other = Path(shutil.copytree(chairs, chairs.parent / "stool"))
    change_rows(other, lambda row: row | {"azimuth_deg": "10", "elevation_deg": "10"})
    load = functools.partial(load_dataset, "photos", chairs.parent, "chair,stool", "train")
    with pytest.raises(
        ValueError, match="stool and chair differ in view classes; give --view-bins"
    ):
        load()
    assert load(view_bins="90x90:-90:90").num_views == 8


def test_other_files_than_tables_are_named(chairs: Path) -> None:
    header = ",".join(COLUMNS)
    for content, message in {
        "": "has the columns ; expected a table of photographs with the columns file, azimuth_deg",
        header: "lists 0 objects; train, val and test need 3",
        "file,azimuth_deg,elevation_deg,distance": "has the columns file, .*, distance; expected",
        f"{header},half_fov_deg": "has the columns .*, half_fov_deg; expected",
        f"{header},{'x' * 100_000}": "has the columns .{0,200}; expected",
        f"{header}\na.jpg,1,2,3,40,5,6": "line 2: it has more or fewer values than there are col",
        f"{header}\na.jpg,1,2": "line 2: it has more or fewer values than there are columns",
        f"{header}\nstühle.jpg,1,2,3,4": r"cannot be read \(Unicode",
    }.items():
        (chairs / "poses.csv").write_text(content, "latin-1")
        refused(chairs, f"poses.csv: {message}")


def test_a_missing_category_is_named_with_those_that_are_there(chairs: Path) -> None:
    with pytest.raises(FileNotFoundError, match="mug: is missing; the folder holds: chair"):
        photos.load(chairs.parent, "mug", "train")
    with pytest.raises(FileNotFoundError, match="give the folder that holds the category"):
        photos.load(chairs, "chair", "train")


def test_objects_must_be_in_one_split(chairs: Path) -> None:
    rows = read_rows(chairs)
    rows[0]["split"] = "val"
    write_rows(chairs, rows)
    refused(chairs, r"poses.csv: object 'chair000' must be in one split, got None, val")
    write_rows(chairs, [row | {"split": ""} for row in rows[1:6]])
    refused(chairs, r"lists 2 objects; train, val and test need 3. Photograph more, or give every")


def test_damaged_photos_are_named_with_their_row(chairs: Path) -> None:
    change_rows(chairs, lambda row: {"split": "train"})
    image, mask = (chairs / "images" / "chair001_1.jpg"), (chairs / "masks" / "chair001_1.png")
    kept = mask.read_bytes()
    Image.new("L", (320, 240)).save(mask)
    refused(chairs, r"chair001_1.jpg: its mask is empty.* \(poses.csv, line 6\)")
    mask.unlink()
    refused(chairs, r"chair001_1.jpg: has no transparency and no mask.* \(poses.csv, line 6\)")
    mask.write_bytes(kept)
    image.unlink()
    refused(chairs, r"chair001_1.jpg: is missing.* \(poses.csv, line 6\)", FileNotFoundError)


@pytest.mark.parametrize(
    ("rows", "column", "factor", "severity", "message"),
    [
        (
            slice(None),
            "distance",
            12,
            "error",
            r"poses.csv: the objects are \d+ times as large .*distance must be in",
        ),
        (
            slice(None),
            "fov_deg",
            0.5,
            "warning",
            r"poses.csv: the objects are 0.\d+ times as large .*the full angle",
        ),
        (
            slice(4, 5),
            "distance",
            10,
            "warning",
            r"chair001_1.jpg: .* is the distance in line 6 right\?",
        ),
    ],
    ids=["centimetres", "half an angle", "a point forgotten"],
)
def test_distances_and_angles_that_do_not_fit_the_pictures_are_noticed(
    chairs: Path, rows: slice, column: str, factor: float, severity: str, message: str
) -> None:
    table = [row | {"split": "train"} for row in read_rows(chairs)]
    for row in table[rows]:
        row[column] = str(float(row[column]) * factor)
    write_rows(chairs, table)
    [(name, text)] = check(chairs, severity)
    assert re.fullmatch(f"{message}.*", f"{name}: {text}")
    if severity == "error":
        refused(chairs, message)


def draw_into_mask(chairs: Path, *areas: tuple[slice, slice]) -> None:
    path = chairs / "masks" / "chair002_0.png"
    mask = np.array(Image.open(path))
    for area in areas:
        mask[area] = 255
    Image.fromarray(mask).save(path)


def test_objects_that_are_cut_off_are_warned_of(chairs: Path) -> None:
    draw_into_mask(chairs, np.s_[100:110, :150])
    message = "its object touches the border; parts outside the image count as empty"
    assert check(chairs, "warning") == [("chair002_0.jpg", message)]


def test_masks_with_more_than_the_object_and_images_without_a_row_are_said(
    chairs: Path, capsys
) -> None:
    clean = {
        split: photos.load(chairs.parent, "chair", split).images
        for split in ("train", "val", "test")
    }
    draw_into_mask(chairs, np.s_[4:20, 4:20], np.s_[200, 300])
    for name in ("b.jpg", "a.jpg", ".hidden"):
        shutil.copyfile(chairs / "images" / "chair002_0.jpg", chairs / "images" / name)
    unlisted = "images without a row, which are not used: 2, the first is a.jpg"
    found = dict(check(chairs, "warning"))
    assert found.keys() == {"poses.csv", "chair002_0.jpg"}
    left_out = found["chair002_0.jpg"]
    assert found["poses.csv"] == unlisted
    assert re.fullmatch(r"2 parts away from the object, \d% of its size, were left out", left_out)
    assert capsys.readouterr().err == ""
    for split, images in clean.items():
        dataset = load_dataset("photos", chairs.parent, "chair", split)
        np.testing.assert_array_equal(dataset.images, images)
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 3 and all(f"poses.csv: {unlisted}" in line for line in said)
    assert sum(line.endswith("--layout photos)") for line in said) == 1, "1 more in one split"
