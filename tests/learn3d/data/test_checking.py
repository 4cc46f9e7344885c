"""The check of whole folders, in any layout, and the command around it; what readers find is tested with them."""

from __future__ import annotations

import json

import pytest
from reader_checks import cut_short

from learn3d.data.checking import check_folder

AIRPLANE = "02691156"


def test_a_sound_folder(tiny_folder) -> None:
    found = [(s.category, s.split, s.objects, s.problems) for s in check_folder("kato", tiny_folder).splits]
    assert found == [(AIRPLANE, "train", 3, ()), (AIRPLANE, "val", 1, ()), (AIRPLANE, "test", 1, ())]


def test_what_was_asked_for_and_is_not_there_is_an_error(tiny_folder, tmp_path) -> None:
    report = check_folder("kato", tiny_folder, ["table"], ["train", "test"])
    assert [(s.split, s.objects, s.count("error")) for s in report.splits] == [("train", 0, 2), ("test", 0, 2)]
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        check_folder("kato", tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"'dvr'; it is .* 'kato': add --layout kato"):
        check_folder("dvr", tiny_folder)
    with pytest.raises(ValueError, match="layout must be one of kato, dvr"):
        check_folder("lsm", tiny_folder)


def test_command_prints_problems_and_a_table_and_says_by_its_exit_code(tiny_folder, tmp_path, command) -> None:
    status, printed, _ = command("check-dataset", tiny_folder, "--category", "airplane", "--split", "train")
    assert status == 0 and "0 errors, 0 warnings" in printed
    rows = [line.split() for line in printed.splitlines() if line]
    assert rows[:2] == [["category", "split", "objects", "errors", "warnings"], ["airplane", "train", "3", "0", "0"]]

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

    status, _, said = command("check-dataset", tmp_path, "--layout", "r2n2")
    assert status == 1 and "nothing of the layout 'r2n2'" in said
