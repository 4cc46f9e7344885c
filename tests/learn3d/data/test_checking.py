"""The check of whole folders: everything wrong at once, in any layout, and the command around it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from reader_checks import cut_short
from shapenet_files import CHAIR, write_kar

from learn3d.commands import main
from learn3d.data.checking import check_folder

LISTS = {"train": ["b1"], "val": ["c2"], "test": ["a0"]}


def write_kato(folder, split, images=2, voxels=2, prefix=CHAIR):
    rng = np.random.default_rng(0)
    np.savez(folder / f"{prefix}_{split}_images.npz", rng.integers(0, 256, (images, 24, 4, 64, 64), np.uint8))
    np.savez(folder / f"{prefix}_{split}_voxels.npz", rng.random((voxels, 32, 32, 32)) < 0.5)


def test_sound_folder_of_kato(tmp_path):
    write_kato(tmp_path, "train", 3, 3)
    write_kato(tmp_path, "val", prefix="own_shapes")
    report = check_folder("kato", tmp_path)
    assert (report.errors, report.warnings) == (0, 0)
    assert [(s.category, s.split, s.objects) for s in report.splits] == [(CHAIR, "train", 3), ("own_shapes", "val", 2)]


def test_everything_wrong_with_katos_files(tmp_path):
    for split in ("train", "val", "test"):
        write_kato(tmp_path, split)
    cut_short(tmp_path / f"{CHAIR}_train_images.npz")
    np.savez(tmp_path / f"{CHAIR}_train_voxels.npz", np.zeros((2, 16, 16, 16), bool))
    (tmp_path / f"{CHAIR}_val_voxels.npz").unlink()
    write_kato(tmp_path, "test", images=3)
    with np.load(tmp_path / f"{CHAIR}_test_images.npz") as file:
        images = file["arr_0"]
    images[1, 5, 3] = 0
    np.savez(tmp_path / f"{CHAIR}_test_images.npz", images)
    voxels = np.ones((2, 32, 32, 32), bool)
    voxels[1] = False
    np.savez(tmp_path / f"{CHAIR}_test_voxels.npz", voxels)

    report = check_folder("kato", tmp_path, ["chair"])
    found = {s.split: [(p.severity, p.message) for p in s.problems] for s in report.splits}
    for split, severity, message in [
        ("train", "error", "cannot be read"),
        ("train", "error", "no pickled objects, got bool [2, 16, 16, 16]"),
        ("val", "error", "but a split needs the voxels"),
        ("test", "error", "holds 3 objects but"),
        ("test", "warning", "the mask of object 1, view 5, is empty"),
        ("test", "warning", "the grid of object 1 is empty"),
    ]:
        assert any(s == severity and message in m for s, m in found[split]), (message, found[split])
    assert (report.errors, report.warnings) == (4, 2)


def test_everything_wrong_with_a_folder_of_renders(tmp_path):
    write_kar(tmp_path, LISTS | {"test": ["a0", "gone"], "val": ["c2", "b1"]}, 64)
    for path in sorted((tmp_path / "renders" / CHAIR / "gone").iterdir()):
        path.unlink()
    (tmp_path / "renders" / CHAIR / "gone").rmdir()
    root = tmp_path / "renders" / CHAIR / "a0"
    cut_short(root / "render_3.png")
    (root / "render_4.png").unlink()
    (root / "view.txt").write_text("nan nan nan nan\n" * 20)
    path = tmp_path / "voxels" / "modelVoxels32" / CHAIR / "a0.mat"
    scipy.io.savemat(path, {"Volume": np.zeros((32, 32, 32))})

    report = check_folder("kar", tmp_path)
    by_split = {s.split: s for s in report.splits}
    assert {s: (r.objects, r.errors, r.warnings) for s, r in by_split.items()} == {
        "train": (1, 0, 1),
        "val": (2, 0, 1),
        "test": (2, 4, 1),
    }
    names = {Path(p.path).name for p in by_split["test"].problems}
    assert names == {"render_3.png", "render_4.png", "view.txt", "a0.mat", "gone"}


def test_what_was_asked_for_and_is_not_there_is_an_error(tmp_path):
    write_kato(tmp_path, "train")
    report = check_folder("kato", tmp_path, ["table"], ["train", "test"])
    assert [(s.split, s.objects, s.errors) for s in report.splits] == [("train", 0, 2), ("test", 0, 2)]
    assert check_folder("kato", tmp_path, splits=["val"]).errors == 2
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        check_folder("kato", tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"'dvr'; it is .* 'kato': add --layout kato"):
        check_folder("dvr", tmp_path)
    with pytest.raises(ValueError, match="layout must be one of kato, dvr"):
        check_folder("lsm", tmp_path)


@pytest.fixture
def command(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["learn3d"])
    return lambda *arguments: main("check-dataset", *map(str, arguments))


def test_command_prints_problems_and_a_table_and_says_by_its_exit_code(tmp_path, command, capsys):
    write_kato(tmp_path, "train")
    assert command(tmp_path, "--category", "chair", "--split", "train") == 0
    printed = capsys.readouterr().out
    assert "0 errors, 0 warnings" in printed
    rows = [line.split() for line in printed.splitlines() if line]
    assert rows[:2] == [["category", "split", "objects", "errors", "warnings"], ["chair", "train", "2", "0", "0"]]

    cut_short(tmp_path / f"{CHAIR}_train_images.npz")
    (tmp_path / f"{CHAIR}_train_voxels.npz").unlink()
    assert command(tmp_path, "--json", tmp_path / "report.json", "--most", 1) == 1
    printed = capsys.readouterr().out
    assert printed.startswith("error: ") and "... and 1 more" in printed and "2 errors, 0 warnings" in printed
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["errors"], report["warnings"], report["layout"]) == (2, 0, "kato")
    assert [p["severity"] for p in report["splits"][0]["problems"]] == ["error", "error"]

    assert command(tmp_path, "--layout", "r2n2") == 1
    assert "error: " in (text := capsys.readouterr().err) and "nothing of the layout 'r2n2'" in text


def test_a_set_without_objects_is_an_error(tmp_path):
    write_kato(tmp_path, "train", 0, 0)
    (problem,) = check_folder("kato", tmp_path).splits[0].problems
    assert problem.severity == "error" and "holds no object" in problem.message
