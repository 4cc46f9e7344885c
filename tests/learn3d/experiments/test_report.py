"""Reports: the paper's figures beside ours, in every format."""

from __future__ import annotations

import dataclasses
import json
import math
import re

import pytest

from learn3d.experiments import formats
from learn3d.experiments.experiment import Call, run_experiment
from learn3d.experiments.plan import Options
from learn3d.experiments.tables import TABLES


def test_report_has_the_papers_figures_beside_ours(report) -> None:
    vanilla, proposed = report["rows"]
    cell = proposed["cells"]["airplane"]
    assert cell["values"]["kato18"] == pytest.approx(0.45)  # objects .40 to .48, seeds + 0, .01, .02
    assert (cell["paper"], cell["seeds"], cell["objects"], cell["images"]) == (0.565, [0, 1, 2], 5, 120)
    assert "difference" not in cell, "the paper's figures are of other data"
    half = 4.302653 * 0.01 / math.sqrt(3)
    assert cell["interval_seeds"]["kato18"] == pytest.approx([0.45 - half, 0.45 + half])
    assert cell["interval_objects"]["kato18"][0] < 0.45 < cell["interval_objects"]["kato18"][1]
    assert cell["to_baseline"]["value"] == pytest.approx(0.1)
    assert cell["to_baseline"]["interval_objects"] == pytest.approx([0.1, 0.1]), "paired: every object gains .1"
    assert cell["to_baseline"]["interval_seeds"] == pytest.approx([0.1, 0.1]), "and every seed, however far apart"
    assert "to_baseline" not in vanilla["cells"]["airplane"]
    mean = proposed["cells"]["mean"]
    assert mean["paper"] == pytest.approx((0.565 + 0.415) / 2), "the paper's mean over the same categories"
    assert (mean["paper_printed"], mean["objects"]) == (0.524, 10)


def test_report_files_tell_the_same(report, tmp_path) -> None:
    out = tmp_path / "out"
    runs = report["runs"]
    assert len(runs) == 12
    assert runs[0]["run"] == "airplane/vanilla-seed0"
    assert (runs[0]["kato18"], runs[0]["commit"]) == (pytest.approx(0.34), "012345678")
    text = (out / "kato.md").read_text()
    assert "| Proposed | paper (kato18) | 0.565 | 0.415 | 0.490 |" in text
    assert "| difference | +0.100 ±0.000 [+0.100, +0.100] |" in text
    assert "learn3d train --preset peng2020-kato --data DATA --category CATEGORY" in text
    assert str(tmp_path) not in text, "no path of this machine gets into a page"
    page = (out / "kato.html").read_text()
    assert page.startswith("<!doctype html>")
    assert "0.565" in page
    assert not {"http://", "https://", "src="} & set(page.split("=")), "nothing is loaded from elsewhere"


def test_seeds_that_were_measured_on_different_objects_have_no_mean(report, tmp_path, make) -> None:
    path = tmp_path / "out/runs/chair/proposed-seed1/test.json"
    result = json.loads(path.read_text())
    result["objects"]["names"][0] = "another"
    path.write_text(json.dumps(result))
    asked = {"categories": ("airplane", "chair"), "methods": ("vanilla", "proposed"), "iterations": 6, "batch_size": 4}
    options = Options(tmp_path / "data", tmp_path / "out", seeds=3, **asked)
    with pytest.raises(ValueError, match="measured on different test objects"):
        make(Call("kato", options, report_only=True))


def test_mmd_is_compared_by_ratio(tmp_path, make, options) -> None:
    make(Call("mmd", options()))
    proposed = json.loads((tmp_path / "out" / "mmd.json").read_text())["rows"][1]
    assert proposed["cells"]["airplane"]["to_baseline"]["ratio"] == pytest.approx(0.6 / 0.7)
    assert "(x 0.86)" in (tmp_path / "out" / "mmd.md").read_text()


def test_quoted_rows_are_marked_and_never_trained(tmp_path, make, monkeypatch, capsys, options) -> None:
    table, quoted = TABLES["kato"], [row for row in TABLES["pascal"].rows if row.variant is None]
    monkeypatch.setitem(TABLES, "kato", dataclasses.replace(table, rows=(*quoted, *table.rows)))
    assert make(Call("kato", options())) == 0
    text = (tmp_path / "out" / "kato.md").read_text()
    assert "| CSDM | paper, quoted from Kar et al. 2015 (voxeliser not stated) | 0.398 | 0.398 |" in text
    assert "| CMR | paper, quoted from Kanazawa et al. 2018 (voxeliser not stated) | 0.460 | 0.460 |" in text
    assert {run["variant"] for run in json.loads((tmp_path / "out" / "kato.json").read_text())["runs"]} == {
        "vanilla",
        "proposed",
    }


def test_report_only_trains_nothing(report, tmp_path, make) -> None:
    given = Options(tmp_path / "data", tmp_path / "out", ("airplane",), ("vanilla", "proposed"), 6, 4, seeds=4)
    assert make(Call("kato", given, report_only=True)) == 0
    again = json.loads((tmp_path / "out" / "kato.json").read_text())
    assert again["missing"] == ["airplane/vanilla-seed3", "airplane/proposed-seed3"]
    for row, before in zip(again["rows"], report["rows"], strict=True):
        assert row["cells"]["airplane"] == before["cells"]["airplane"]


def test_runs_of_other_options_are_left_out(make, tmp_path, options, capsys) -> None:
    assert make(Call("kato", options())) == 0
    make(Call("kato", dataclasses.replace(options(), batch_size=64), report_only=True))
    said = capsys.readouterr().err
    assert "left out: " in said and "vanilla-seed0 has a run with other options: batch_size: 4" in said
    assert "airplane/vanilla-seed0" in json.loads((tmp_path / "out" / "kato.json").read_text())["missing"]


def test_the_table_on_the_terminal_is_aligned_and_says_how_long_ours_were_trained(make, capsys, options) -> None:
    make(Call("kato", options(iterations=5)))
    header, *rows, reference, trained = capsys.readouterr().out.splitlines()
    assert reference.startswith("paper: on its own data")
    assert trained == "here: trained for 5 iterations of batch 4"
    starts = [match.start() for match in re.finditer(r"\S+", header)]
    assert len(starts) == 3 and len(rows) >= 4
    for row in rows:
        assert all(row[start - 2 : start] == "  " and row[start] != " " for start in starts[1:]), row


def test_names_in_results_are_no_html(report) -> None:
    report["runs"][0] |= {"commit": "<b>\n|"}
    assert "| &lt;b&gt; \\| |\n" in formats.to_markdown(report)


def test_calls_that_make_no_sense(options) -> None:
    with pytest.raises(ValueError, match="no table 'katoo'; choose one of kato, prgan"):
        run_experiment(Call("katoo", options()))
    with pytest.raises(ValueError, match="jobs must be"):
        run_experiment(Call("kato", options(), jobs=0))
    with pytest.raises(ValueError, match="give one of them"):
        run_experiment(Call("kato", options(), report_only=True, overwrite=True))


def test_a_damaged_result_is_named(tmp_path, make, options) -> None:
    make(Call("kato", options()))
    (tmp_path / "out/runs/airplane/vanilla-seed0/test.json").write_text("{")
    with pytest.raises(ValueError, match=r"vanilla-seed0/test.json .* remove it"):
        make(Call("kato", options(), report_only=True))
