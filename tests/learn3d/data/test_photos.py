"""Your own photographs: the example's folder is read end to end, and every mistake in a table is named."""

from __future__ import annotations

import csv
import json
import re
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import nmr
from learn3d.config import TrainConfig
from learn3d.data.layouts import load_dataset
from learn3d.data.poses import LookAtPoses
from learn3d.data.readers import photos
from learn3d.data.readers.photo_table import split_objects
from learn3d.evaluation import evaluate
from learn3d.methods.method import DatasetInfo
from learn3d.methods.pose_invariant import PoseInvariant, PoseInvariantSettings
from learn3d.runs import checkpoint
from learn3d.training import train

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "make_photo_folder.py"
COLUMNS = ["file", "azimuth_deg", "elevation_deg", "distance", "fov_deg"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    return runpy.run_path(str(EXAMPLE))["main"](folder, "chair", objects=4, photos=3).parent


def test_the_best_networks_are_those_with_the_best_silhouettes(made: Path, tmp_path: Path) -> None:
    settings = PoseInvariantSettings(encoder="conv-small", generator="sphere-small", learning_rate=0.01)
    about = {"data": made, "category": "chair", "layout": "photos", "settings": settings, "output": tmp_path / "run"}
    about["preset"] = "peng2020-kato"
    summary = train(TrainConfig(**about, iterations=3, batch_size=4, precision="fp32", validate_every=1))
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    measured = {line["step"]: line["silhouette_iou"] for line in lines if line["split"] == "val"}
    assert summary.best_step == max(measured, key=measured.get)
    method, _, metadata = checkpoint.load_method(tmp_path / "run" / "best.safetensors")
    assert metadata.progress.step == summary.best_step and measured[summary.best_step] == summary.best_iou
    again = evaluate(method, load_dataset("photos", made, "chair", "val")).silhouette_iou
    assert float(again.mean()) == pytest.approx(summary.best_iou, abs=1e-5)


@pytest.fixture
def chairs(made: Path, tmp_path: Path) -> Path:
    """A copy to damage: the folder of the category."""
    return Path(shutil.copytree(made / "chair", tmp_path / "data" / "chair"))


def read_rows(folder: Path) -> list[dict[str, str]]:
    with open(folder / "poses.csv", newline="") as file:
        return list(csv.DictReader(file))


def write_rows(folder: Path, rows: list[dict[str, str]], delimiter: str = ",", encoding: str = "utf-8") -> None:
    with open(folder / "poses.csv", "w", newline="", encoding=encoding) as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)), delimiter=delimiter)
        writer.writeheader()
        writer.writerows(rows)


def scan(folder: Path) -> list[tuple[str, str]]:
    """(file, what is wrong) for all splits that a folder has."""
    found = [p for split in photos.contents(folder)["chair"] for p in photos.problems(folder, "chair", split)]
    return [(Path(p.path).name, p.message) for p in found]


def test_the_examples_folder_is_read(made: Path) -> None:
    sets = {split: photos.load(made, "chair", split) for split in ("train", "val", "test")}
    assert {split: (len(s), s.num_objects) for split, s in sets.items()} == {
        "train": (6, 2),
        "val": (3, 1),
        "test": (3, 1),
    }
    assert len({name for s in sets.values() for name in s.object_names}) == 4  # no object is in two splits
    train = sets["train"]
    assert train.voxels is None and train.masks is None and train.inverted and train.image_size == 64
    assert all(s.view_names == train.view_names for s in sets.values())
    assert sorted(set(train.view_ids)) == list(range(train.num_views))
    row = next(row for row in read_rows(made / "chair") if row["object"] == train.object_names[0])
    assert float(train.poses.azimuth_deg[0]) == pytest.approx(float(row["azimuth_deg"]))
    assert float(train.poses.distance[0]) == pytest.approx(float(row["distance"]))
    assert float(train.poses.half_fov_deg[0]) == pytest.approx(float(row["fov_deg"]) / 2)
    assert (255 - train.images[0, :3, 0, 0]).tolist() == [255, 255, 255]
    large = photos.load(made / "chair", "chair", "val", image_size=224)  # the folder itself will do
    assert large.images.shape == (3, 4, 224, 224) and large.masks.shape == (3, 64, 64)
    np.testing.assert_array_equal(large.masks, sets["val"].images[:, 3])
    assert scan(made) == scan(made / "chair") == []
    assert photos.contents(made) == {"chair": ("train", "val", "test")} and photos.count(made, "chair", "train") == 2
    assert len(load_dataset("photos", made, "chair", "train")) == 6
    assert load_dataset("photos", made, "chair", "train", view_bins="90x30:0:60").num_views == 8


def test_a_method_trains_on_it(made: Path) -> None:
    train = photos.load(made, "chair", "train")
    torch.manual_seed(0)
    method = PoseInvariant(PoseInvariantSettings(), DatasetInfo(train.num_views), "cpu", "fp32")
    for step in (1, 2):
        losses = method.take_step(train.batch(torch.arange(4)), step)
    assert np.isfinite(losses["total"]) and 0 < losses["projection"] < 1
    shapes = method.decode(method.encode(torch.from_numpy(train.images[:1])))
    assert shapes.vertices.shape == (1, 642, 3)


def test_azimuth_grows_to_the_photographers_right() -> None:
    """A mark on the object's right, as its front photo shows it, faces a camera at azimuth 90; elevation is up."""
    mark = torch.tensor([[[0.5, -0.1, -0.1], [0.5, -0.1, 0.1], [0.5, 0.2, 0.0]]])
    poses = LookAtPoses(torch.tensor([0.0, 90.0, 0.0]), torch.tensor([0.0, 0.0, 45.0]), 3.0, 20.0)
    seen = poses.cameras().transform(mark.expand(3, 3, 3))
    assert (seen[0, :, 0] > 0.3).all()  # on the right of the front photo
    assert seen[1, :, 0].abs().max() < 0.2 and (seen[1, :, 2] < 3).all()  # in the middle, on the near side
    eye = nmr.cameras.points_from_angles(1.0, 45.0, 0.0)
    assert eye[1] > 0


@pytest.mark.parametrize("table", ["semicolons", "bom", "spaces"])
def test_tables_of_other_programs_are_read(chairs: Path, table: str) -> None:
    wanted = photos.load(chairs, "chair", "train")
    rows = read_rows(chairs)
    if table == "spaces":
        text = (chairs / "poses.csv").read_text().replace(",", " , ")
        (chairs / "poses.csv").write_text(text)
    else:
        write_rows(chairs, rows, *{"semicolons": (";",), "bom": (",", "utf-8-sig")}[table])
    dataset = photos.load(chairs, "chair", "train")
    np.testing.assert_array_equal(dataset.images, wanted.images)
    assert torch.equal(dataset.poses.azimuth_deg, wanted.poses.azimuth_deg)


def test_the_tables_own_splits_and_masks_count(chairs: Path) -> None:
    rows = read_rows(chairs)
    (chairs / "masks" / "other.png").write_bytes((chairs / "masks" / f"{Path(rows[0]['file']).stem}.png").read_bytes())
    for row in rows:
        row["split"] = "val" if row["object"] == rows[0]["object"] else "train"
        row["mask"] = "masks/other.png" if row is rows[0] else ""
        row["framing"] = "object" if row is rows[1] else ""
    write_rows(chairs, rows)
    val = photos.load(chairs, "chair", "val")
    assert val.object_names == (rows[0]["object"],) and len(photos.load(chairs, "chair", "train")) == 9
    half = [float(v) for v in val.poses.half_fov_deg]
    assert half[0] == half[2] == 20.0 and 8 < half[1] < 20
    with pytest.raises(ValueError, match=r"poses.csv has no photograph in the split 'test'; it has: train, val"):
        photos.load(chairs, "chair", "test")


def test_photos_without_objects_are_objects_of_their_own(chairs: Path) -> None:
    rows = read_rows(chairs)
    for row in rows:
        del row["object"]
    write_rows(chairs, rows)
    sizes = [len(photos.load(chairs, "chair", split)) for split in ("train", "val", "test")]
    assert sizes == [9, 1, 2]


def test_the_split_of_an_object_is_a_matter_of_its_name(made: Path) -> None:
    table = made / "chair" / "poses.csv"
    rows = [photos.Photo("", Path(f"{k}.jpg"), None, 0, 0, 3, 40, f"object{k}", None, "whole") for k in range(200)]
    one = split_objects(table, rows)
    assert [list(one.values()).count(split) for split in ("train", "val", "test")] == [140, 20, 40]
    assert split_objects(table, rows[::-1]) == one
    fewer = split_objects(table, rows[10:])
    assert sum(fewer[name] != one[name] for name in fewer) < 10


BIN_CASES = {
    # elevations, azimuths, photographs -> azimuth width, elevation cells
    "all around, few": ((5.0, 45.0), (-180.0, 180.0), 60, (90, 2)),
    "all around, many": ((5.0, 45.0), (-180.0, 180.0), 2000, (15, 2)),
    "in between": ((-20.0, 40.0), (-180.0, 180.0), 300, (30, 3)),
    "one height, from the front": ((30.0, 30.0), (-30.0, 30.0), 60, (15, 1)),
}


@pytest.mark.parametrize("name", BIN_CASES)
def test_default_view_classes_suit_the_photos(name: str) -> None:
    elevations, azimuths, count, (width, rows) = BIN_CASES[name]
    rng = np.random.default_rng(0)
    poses = LookAtPoses(rng.uniform(*azimuths, count), rng.uniform(*elevations, count), 3.0, 20.0)
    bins = photos.choose_bins(poses)
    assert bins.azimuth_width_deg == width and bins.shape[1] == rows
    assert bins.elevation_low_deg <= elevations[0] + 1 and bins.elevation_high_deg >= elevations[1] - 1


def test_a_direction_without_training_photos_gets_the_nearest_class() -> None:
    training = LookAtPoses(torch.tensor([0.0] * 8 + [100.0] * 8), torch.full((16,), 20.0), 3.0, 20.0)
    other = LookAtPoses(torch.tensor([1.0, 140.0, -60.0, -100.0]), torch.full((4,), 20.0), 3.0, 20.0)
    ids, names = photos._view_classes(other, training)
    assert len(names) == 2 and ids.tolist() == [0, 1, 0, 0]


MISTAKES = {
    # column, value -> what is said
    "text": ("azimuth_deg", "left", "azimuth_deg must be a number, got 'left'"),
    "comma": ("azimuth_deg", "12,5", "azimuth_deg must be a number, got '12,5'; write a point, not a comma"),
    "empty": ("distance", "", "distance must be a number, got ''"),
    "nan": ("fov_deg", "nan", "fov_deg must lie between 0.1 and 170, got nan"),
    "above": ("elevation_deg", "90", "elevation_deg must lie between -90 and 90, got 90"),
    "inside": (
        "distance",
        "0.3",
        r"distance must lie between 0.5 and 10000 lengths of the longest side, got 0.3",
    ),
    "wide": ("fov_deg", "180", "fov_deg must lie between 0.1 and 170, got 180"),
    "split": ("split", "training", "split must be one of train, val, test, got 'training'"),
    "framing": ("framing", "crop", "framing must be one of whole, object, got 'crop'"),
    "no file": ("file", "", "file must be the name of a file in images/, got ''"),
    "outside": ("file", "../secret.png", "file must be the name of a file in images/, got '../secret.png'"),
    "absolute": ("mask", "/etc/passwd", "mask must be the name of a file in masks/, got '/etc/passwd'"),
    "twice": ("file", "chair000_0.jpg", "chair000_0.jpg is in poses.csv, line 2 already"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_in_a_row_are_named(chairs: Path, name: str) -> None:
    column, value, message = MISTAKES[name]
    rows = read_rows(chairs)
    rows[4][column] = value
    write_rows(chairs, rows)
    with pytest.raises(ValueError, match=rf"chair: poses.csv, line 6: {message}$"):
        photos.load(chairs, "chair", "train")
    assert next(text.split(":")[0] for _, text in scan(chairs)) == "poses.csv, line 6"


def test_all_mistakes_are_counted_and_listed(chairs: Path) -> None:
    rows = read_rows(chairs)
    rows[1]["distance"], rows[3]["fov_deg"] = "far", "0"
    write_rows(chairs, rows)
    with pytest.raises(ValueError, match=r"line 3: distance must be a number, got 'far' \(and 1 more\)$"):
        photos.load(chairs, "chair", "train")
    assert [name for name, _ in scan(chairs)] == ["poses.csv", "poses.csv"]


def test_tables_that_are_none_are_named(chairs: Path, tmp_path: Path) -> None:
    table = chairs / "poses.csv"
    with pytest.raises(FileNotFoundError, match=r"no .*none/chair/poses.csv and no .*none/poses.csv; it must list"):
        photos.load(tmp_path / "none", "chair", "train")
    assert next(photos.problems(tmp_path / "none", "chair", "val")).message.startswith("there is no ")
    with pytest.raises(ValueError, match="split must be one of train, val, test; got 'all'"):
        photos.load(chairs, "chair", "all")

    def refused(content: str | bytes, message: str) -> None:
        table.write_bytes(content.encode() if isinstance(content, str) else content)
        with pytest.raises(ValueError, match=message):
            photos.load(chairs, "chair", "train")
        assert scan(chairs)

    header = ",".join(COLUMNS)
    refused("", "poses.csv lacks file, azimuth_deg, elevation_deg, distance, fov_deg; the columns are file")
    refused(header, "poses.csv lists no photographs")
    refused("file,azimuth_deg,elevation_deg,distance\n", "poses.csv lacks fov_deg; the columns are")
    refused(f"{header},half_fov_deg\n", "poses.csv has unknown half_fov_deg; the columns are")
    refused(f"{header}\na.jpg,1,2,3,40,5,6\n", "line 2: there are more values than columns: 5, 6")
    refused(header.encode() + b"\nst\xfchle.jpg,1,2,3,4\n", "poses.csv is not UTF-8 text .* save it as 'CSV UTF-8'")


@pytest.mark.parametrize("category", ["../out", "..", "/tmp/out", "a\\b", "a\nb", "a\0b", "\udcff"])
def test_categories_are_names(chairs: Path, category: str) -> None:
    """The category of a stranger's model becomes part of the names of the files that reconstruct.py writes."""
    with pytest.raises(ValueError, match=r"category must be the plain name of a folder such as 'mug', got '"):
        load_dataset("photos", chairs, category, "train")
    assert "plain name" in next(photos.problems(chairs, category, "train")).message
    assert load_dataset("photos", chairs, "my mug, x".split(",")[0], "train").category == "my mug"


def test_messages_have_an_end(chairs: Path) -> None:
    header, much = ",".join(COLUMNS), "x" * 100_000
    for text in (f"{header},{much}\n", f"{header}\na.jpg,1,2,3,40,{much}\n"):
        (chairs / "poses.csv").write_text(text)
        with pytest.raises(ValueError, match="x") as refusal:
            photos.load(chairs, "chair", "train")
        assert len(str(refusal.value)) < 1000


def test_objects_must_be_in_one_split(chairs: Path) -> None:
    rows = read_rows(chairs)
    rows[0]["split"] = "val"
    write_rows(chairs, rows)
    with pytest.raises(ValueError, match=r"poses.csv: object 'chair000' must be in one split, got none, val"):
        photos.load(chairs, "chair", "train")
    assert any("must be in one split" in text for _, text in scan(chairs))
    write_rows(chairs, read_rows(chairs)[1:6])
    for row in (rows := read_rows(chairs)):
        del row["split"]
    write_rows(chairs, rows)
    with pytest.raises(ValueError, match=r"lists 2 object\(s\); at least 3 are needed .* give every row a split"):
        photos.load(chairs, "chair", "train")


def test_damaged_photos_are_named_with_their_row(chairs: Path) -> None:
    rows = read_rows(chairs)
    for row in rows:
        row["split"] = "train"
    write_rows(chairs, rows)

    def refused(message: str, kind: type = ValueError) -> None:
        with pytest.raises(kind, match=message):
            photos.load(chairs, "chair", "train")

    image, mask = (chairs / "images" / "chair001_1.jpg"), (chairs / "masks" / "chair001_1.png")
    kept = mask.read_bytes()
    Image.new("L", (320, 240)).save(mask)
    refused(r"chair001_1.jpg: its mask is empty.* \(poses.csv, line 6\)")
    mask.unlink()
    refused(r"chair001_1.jpg: has no transparency and no mask.* \(poses.csv, line 6\)")
    mask.write_bytes(kept)
    image.write_bytes(image.read_bytes()[:1000])
    refused(r"chair001_1.jpg: cannot be decoded as an image.* \(poses.csv, line 6\)")
    image.unlink()
    refused(r"chair001_1.jpg: is missing.* \(poses.csv, line 6\)", FileNotFoundError)
    assert [name for name, _ in scan(chairs)] == ["chair001_1.jpg"]


def test_distances_in_another_unit_are_noticed(chairs: Path) -> None:
    rows = read_rows(chairs)
    for row in rows:
        row["distance"] = str(float(row["distance"]) * 12)  # centimetres of an object of 12 cm
    write_rows(chairs, rows)
    with pytest.raises(
        ValueError, match=r"poses.csv: the objects are \d+ times as large in the photographs as distance"
    ):
        photos.load(chairs, "chair", "train")
    assert [name for name, text in scan(chairs) if "times as large" in text] == ["poses.csv"] * 3


def test_one_wrong_distance_is_warned_of(chairs: Path) -> None:
    rows = read_rows(chairs)
    for row in rows:
        row["split"] = "train"
    rows[4]["distance"] = str(float(rows[4]["distance"]) * 10)  # a point forgotten
    write_rows(chairs, rows)
    [(name, text)] = scan(chairs)
    assert name == rows[4]["file"] and re.search(r"times as large as its row says \(poses.csv, line 6\)", text)
    photos.load(chairs, "chair", "train")


def test_half_of_the_field_of_view_is_warned_of(chairs: Path) -> None:
    assert not [text for _, text in scan(chairs) if "times as large" in text]
    rows = read_rows(chairs)
    for row in rows:
        row["fov_deg"] = str(float(row["fov_deg"]) / 2)
    write_rows(chairs, rows)
    assert any("is fov_deg the full angle" in text for _, text in scan(chairs))
    photos.load(chairs, "chair", "train")


def test_the_scan_also_tells_of_cut_objects_and_forgotten_files(chairs: Path) -> None:
    path = chairs / "masks" / "chair002_0.png"
    mask = np.array(Image.open(path))
    mask[100:110, :150] = 255
    Image.fromarray(mask).save(path)
    (chairs / "images" / "new.jpg").write_bytes((chairs / "images" / "chair000_0.jpg").read_bytes())
    (chairs / "images" / "notes.txt").write_text("x")
    assert sorted(scan(chairs)) == [
        ("chair002_0.jpg", "its object touches the border; what lies outside counts as empty"),
        ("new.jpg", "it is not in poses.csv"),
    ]
