"""Layouts: loading and checking a data set of any of them."""

from __future__ import annotations

import inspect
import json
import shutil
from typing import get_args

import numpy as np
import pytest
from reader_checks import cut_short
from shapenet_files import CHAIR, write_dvr, write_kar

from learn3d.data.layouts import LAYOUTS, Layout, check_folder, check_options, load_dataset, reader
from learn3d.data.readers import renderings

TABLE = "04379243"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """One folder per layout, each with the categories chair and table (the same files twice)."""
    root = tmp_path_factory.mktemp("layouts")
    rng = np.random.default_rng(0)
    (root / "kato").mkdir()
    for prefix in (CHAIR, TABLE):
        np.savez(
            root / "kato" / f"{prefix}_test_images.npz",
            rng.integers(0, 256, (2, 24, 4, 64, 64), np.uint8),
        )
        np.savez(root / "kato" / f"{prefix}_test_voxels.npz", rng.random((2, 32, 32, 32)) < 0.5)
    write_dvr(root / "dvr", {"test": ["a0"]})
    write_kar(root / "kar", {"train": ["b1"], "val": ["c2"], "test": ["a0"]}, 64)
    for path in (p for layout in ("dvr", "kar") for p in list((root / layout).rglob(CHAIR))):
        shutil.copytree(path, path.with_name(TABLE))
    lists = json.loads((root / "kar" / "splits.json").read_text())
    (root / "kar" / "splits.json").write_text(json.dumps(lists | {TABLE: lists[CHAIR]}))
    return root


@pytest.mark.parametrize(
    ("layout", "views", "classes"), [("kato", 48, 24), ("dvr", 24, 24), ("kar", 20, 72)]
)
def test_one_category_or_several(folders, layout, views, classes) -> None:
    one = load_dataset(layout, folders / layout, "chair", "test")
    assert (len(one), one.num_views, one.num_classes) == (views, classes, 1)
    both = load_dataset(layout, folders / layout, "chair, table", "test", view_bins="90x90:-90:90")
    assert (len(both), both.num_views, both.num_classes) == (2 * views, 8, 2)
    assert both.view_names[0] == "azimuth -135°, elevation -45°"
    assert both.class_names == ("chair", "table") and both.category == "chair,table"
    assert both.class_ids.tolist() == [0] * one.num_objects + [1] * one.num_objects
    few = load_dataset(layout, folders / layout, "chair", "test", views_per_object=2)
    assert len(few) == 2 * one.num_objects


def test_a_folder_that_is_not_there_or_of_another_layout_is_named(
    folders, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder, message in (
        (
            "data",
            rf"data: there is no such folder \({tmp_path / 'data'}\); give the folder of the data set",
        ),
        (tmp_path / "nowhere", "nowhere: there is no such folder; give"),
        (folders / "kar", "kar: this is a data set of the layout 'kar', not 'dvr'; .*--layout"),
    ):
        with pytest.raises(FileNotFoundError, match=message):
            load_dataset("dvr", folder, "chair", "test")


def test_progress_is_shown_on_a_terminal_only(folders, capsys, monkeypatch) -> None:
    load_dataset("dvr", folders / "dvr", "chair", "test")
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(renderings, "is_watched", lambda: True)
    load_dataset("dvr", folders / "dvr", "chair", "test")
    assert "chair" in capsys.readouterr().err


@pytest.mark.parametrize("layout", LAYOUTS)
def test_options_of_a_layout(layout) -> None:
    known = set(inspect.signature(reader(layout).load).parameters) & {
        "image_size",
        "views_per_object",
    }
    assert known == set(LAYOUTS[layout].options)
    if "image_size" in known:
        check_options(layout, image_size=224)
    else:
        with pytest.raises(
            ValueError,
            match=f"images of the layout '{layout}' have 64x64 pixels, but 224 are wanted",
        ):
            check_options(layout, image_size=224)


def test_unknown_names(folders) -> None:
    assert tuple(LAYOUTS) == get_args(Layout)
    with pytest.raises(ValueError, match=r"layout must be one of kato, .* got 'lsm'"):
        load_dataset("lsm", folders, "chair", "test")
    for category in ("chair,chair", "", "chair,"):
        with pytest.raises(ValueError, match="different names joined by commas, got"):
            load_dataset("kato", folders / "kato", category, "test")


AIRPLANE = "02691156"


def test_missing_categories_and_splits_are_errors(tiny_folder, tmp_path) -> None:
    found = check_folder("kato", tiny_folder, ["table"], ["train", "test"])
    assert [(s.split, s.objects, s.count("error")) for s in found] == [
        ("train", 0, 2),
        ("test", 0, 2),
    ]
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        check_folder("kato", tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="layout 'kato', not 'dvr'; add --layout kato"):
        check_folder("dvr", tiny_folder)
    with pytest.raises(ValueError, match="layout must be one of kato, dvr"):
        check_folder("lsm", tiny_folder)


def test_command_prints_problems_and_a_table_and_sets_its_exit_status(
    tiny_folder, tmp_path, command
) -> None:
    status, printed, _ = command("check-dataset", tiny_folder)
    assert status == 0 and "0 errors, 0 warnings" in printed
    rows = [line.split() for line in printed.splitlines() if line]
    assert rows[:2] == [
        ["category", "split", "objects", "errors", "warnings"],
        [AIRPLANE, "train", "3", "0", "0"],
    ]
    assert rows[2:4] == [[AIRPLANE, "val", "1", "0", "0"], [AIRPLANE, "test", "1", "0", "0"]]

    for kind in ("images", "voxels"):
        path = tmp_path / f"{AIRPLANE}_train_{kind}.npz"
        path.write_bytes((tiny_folder / path.name).read_bytes())
        cut_short(path)
    status, printed, _ = command("check-dataset", tmp_path, "--json", tmp_path / "report.json")
    assert status == 1
    assert printed.count("error: ") == 2 and "2 errors, 0 warnings" in printed
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["errors"], report["warnings"], report["layout"]) == (2, 0, "kato")
    assert [p["severity"] for p in report["splits"][0]["problems"]] == ["error", "error"]

    status, _, said = command("check-dataset", tmp_path, "--layout", "dvr")
    assert status == 1 and "layout 'kato', not 'dvr'" in said
