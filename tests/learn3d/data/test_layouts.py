"""Layouts: loading and checking a data set of any of them."""

from __future__ import annotations

import inspect
import json
import shutil
from typing import get_args

import pytest
from reader_checks import cut_short
from shapenet_files import CHAIR, write_dvr

from learn3d import terminal
from learn3d.data.layouts import LAYOUTS, Layout, check_folder, check_options, load_dataset, reader

TABLE = "04379243"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """DVR's layout with the categories chair and table (the same files twice)."""
    root = tmp_path_factory.mktemp("layouts") / "dvr"
    write_dvr(root, {"test": ["a0"]})
    shutil.copytree(root / CHAIR, root / TABLE)
    return root


def test_one_category_or_several(folder) -> None:
    one = load_dataset("dvr", folder, "chair", "test")
    assert (len(one), one.num_views, one.num_classes) == (24, 24, 1)
    both = load_dataset("dvr", folder, "chair, table", "test", view_bins="90x90:-90:90")
    assert (len(both), both.num_views, both.num_classes) == (48, 8, 2)
    assert both.view_names[0] == "azimuth -135°, elevation -45°"
    assert both.class_names == ("chair", "table") and both.category == "chair,table"
    assert both.class_ids.tolist() == [0, 1]
    assert len(load_dataset("dvr", folder, "chair", "test", views_per_object=2)) == 2


def test_a_folder_that_is_not_there_or_of_another_layout_is_named(
    folder, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for layout, where, message in (
        ("dvr", "data", rf"data: there is no such folder \({tmp_path / 'data'}\); give the folder"),
        ("dvr", tmp_path / "nowhere", "nowhere: there is no such folder; give"),
        ("kar", folder, "dvr: this is a data set of the layout 'dvr', not 'kar'; .*--layout"),
    ):
        with pytest.raises(FileNotFoundError, match=message):
            load_dataset(layout, where, "chair", "test")


def test_short_work_shows_progress_on_a_terminal_only(folder, capsys, monkeypatch) -> None:
    load_dataset("dvr", folder, "chair", "test")
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(terminal, "is_watched", lambda: True)
    load_dataset("dvr", folder, "chair", "test")
    assert "chair" in capsys.readouterr().err


@pytest.mark.parametrize("layout", LAYOUTS)
def test_options_of_a_layout(layout) -> None:
    known = inspect.signature(reader(layout).load).parameters.keys()
    assert known & {"image_size", "views_per_object"} == set(LAYOUTS[layout].options)
    if "image_size" in known:
        check_options(layout, image_size=224)
        return
    refused = f"images of the layout '{layout}' have 64x64 pixels, but 224 are wanted"
    with pytest.raises(ValueError, match=refused):
        check_options(layout, image_size=224)


def test_unknown_names(folder) -> None:
    assert tuple(LAYOUTS) == get_args(Layout)
    with pytest.raises(ValueError, match=r"layout must be one of kato, .* got 'lsm'"):
        load_dataset("lsm", folder, "chair", "test")
    for category in ("chair,chair", "", "chair,"):
        with pytest.raises(ValueError, match="different names joined by commas, got"):
            load_dataset("dvr", folder, category, "test")


AIRPLANE = "02691156"


def test_missing_categories_and_splits_are_errors(tiny_folder, tmp_path) -> None:
    found = check_folder("kato", tiny_folder, ["table"], ["train", "test"])
    assert [(s.split, s.objects, s.count("error")) for s in found] == [
        ("train", 0, 2),
        ("test", 0, 2),
    ]
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        check_folder("kato", tmp_path / "nowhere")
    for layout in ("dvr", "kar"):  # kar's list of objects is missing
        with pytest.raises(FileNotFoundError, match=f"'kato', not '{layout}'; add --layout kato"):
            check_folder(layout, tiny_folder)
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
