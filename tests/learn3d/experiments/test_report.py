"""Reports: the paper's figures beside ours, in every format."""

from __future__ import annotations

import dataclasses
import json
import math
import re

import pytest

from learn3d.experiments import formats
from learn3d.experiments.tables import TABLES


def test_report_has_the_papers_figures_beside_ours(report) -> None:
    vanilla, proposed = report["rows"]
    cell = proposed["cells"]["airplane"]
    assert cell["values"]["kato18"] == pytest.approx(0.45)  # objects .40 to .48, seeds + 0, .01, .02
    assert (cell["paper"], cell["seeds"], cell["objects"], cell["images"]) == (0.565, [0, 1, 2], 5, 120)
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


def test_the_page_shows_the_figures_and_no_path(report, tmp_path) -> None:
    runs = report["runs"]
    assert (len(runs), runs[0]["run"], runs[0]["commit"]) == (12, "airplane/vanilla-seed0", "012345678")
    text = (tmp_path / "out" / "kato.md").read_text()
    assert "| Proposed | paper (kato18) | 0.565 | 0.415 | 0.490 |" in text
    assert "| difference | +0.100 ±0.000 [+0.100, +0.100] |" in text
    assert "learn3d train --preset peng2020-kato --data DATA --category CATEGORY" in text
    assert str(tmp_path) not in text
    runs[0] |= {"commit": "<b>\n|"}
    assert "| &lt;b&gt; \\| |\n" in formats.to_markdown(report), "no HTML from names in results"


def test_seeds_that_were_measured_on_different_objects_have_no_mean(report, tmp_path, make, request_for) -> None:
    path = tmp_path / "out/runs/chair/proposed-seed1/test.json"
    result = json.loads(path.read_text())
    result["objects"]["names"][0] = "another"
    path.write_text(json.dumps(result))
    with pytest.raises(ValueError, match="measured on different test objects"):
        make(request_for(category="airplane,chair", seeds=3, report_only=True))


def test_mmd_is_compared_by_ratio(tmp_path, make, request_for) -> None:
    make(request_for("mmd"))
    proposed = json.loads((tmp_path / "out" / "mmd.json").read_text())["rows"][1]
    assert proposed["cells"]["airplane"]["to_baseline"]["ratio"] == pytest.approx(0.6 / 0.7)
    assert "(x 0.86)" in (tmp_path / "out" / "mmd.md").read_text()


def test_quoted_rows_are_marked_and_never_trained(tmp_path, make, monkeypatch, request_for) -> None:
    table, pascal = TABLES["kato"], TABLES["pascal"]
    rows, published = {"CSDM": None, "CMR": None} | table.rows, dict(pascal.published) | table.published
    monkeypatch.setitem(TABLES, "kato", dataclasses.replace(table, rows=rows, published=published))
    assert make(request_for()) == 0
    text = (tmp_path / "out" / "kato.md").read_text()
    assert "| CSDM | paper, quoted from Kar et al. 2015 (voxeliser not stated) | 0.398 | 0.398 |" in text
    assert "| CMR | paper, quoted from Kanazawa et al. 2018 (voxeliser not stated) | 0.460 | 0.460 |" in text
    report = json.loads((tmp_path / "out" / "kato.json").read_text())
    assert {run["variant"] for run in report["runs"]} == {"vanilla", "proposed"}


def test_report_only_trains_nothing(report, tmp_path, make, request_for) -> None:
    assert make(request_for(seeds=4, report_only=True)) == 0
    again = json.loads((tmp_path / "out" / "kato.json").read_text())
    assert again["missing"] == ["airplane/vanilla-seed3", "airplane/proposed-seed3"]
    for row, before in zip(again["rows"], report["rows"], strict=True):
        assert row["cells"]["airplane"] == before["cells"]["airplane"]


def test_the_table_on_the_terminal_is_aligned_and_says_how_long_ours_were_trained(make, capsys, request_for) -> None:
    make(request_for(iterations=5))
    header, *rows, reference, trained = capsys.readouterr().out.splitlines()
    assert reference.startswith("paper: on its own data")
    assert trained == "here: trained for 5 iterations of batch 4"
    starts = [match.start() for match in re.finditer(r"\S+", header)]
    assert len(starts) == 3 and len(rows) >= 4
    for row in rows:
        assert all(row[start - 2 : start] == "  " and row[start] != " " for start in starts[1:]), row
