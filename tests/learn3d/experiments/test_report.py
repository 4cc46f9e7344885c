"""Reports: the paper's figures beside ours, in every format."""

from __future__ import annotations

import copy
import csv
import dataclasses
import json
import math
import re
import shutil
from pathlib import Path

import pytest

from learn3d.experiments import formats
from learn3d.experiments.experiment import Call, run_experiment
from learn3d.experiments.plan import Options
from learn3d.experiments.state import found_runs, read_results
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
    lines = list(csv.DictReader((out / "kato.csv").open()))
    assert len(lines) == 12
    assert lines[0]["run"] == "airplane/vanilla-seed0"
    assert (float(lines[0]["kato18"]), lines[0]["commit"]) == (pytest.approx(0.34), "0123456789ab")
    text = (out / "kato.md").read_text()
    assert "| Proposed | paper (kato18) | 0.565 | 0.415 | 0.490 |" in text
    assert "| difference | +0.100 ±0.000 [+0.100, +0.100] |" in text
    assert "learn3d train --preset peng2020-kato --data DATA --category CATEGORY" in text
    assert str(tmp_path) not in text, "no path of this machine gets into a page"
    changed = report | {"runs": [report["runs"][0] | {"commit": "0123456789ab-dirty"}]}
    assert formats.run_table(changed)[1][-1] == "012345678-dirty"
    page = (out / "kato.html").read_text()
    assert page.startswith("<!doctype html>")
    assert "0.565" in page
    assert not {"http://", "https://", "src="} & set(page.split("=")), "nothing is loaded from elsewhere"


def test_the_published_codes_figures_stand_beside_ours(tmp_path, stub, options) -> None:
    given = options(categories=("airplane", "chair"), iterations=3000)
    assert run_experiment(Call("kato", given, beside_code=True), worker=stub) == 0
    text = (tmp_path / "out" / "kato.md").read_text()
    assert "|  | published code, same meshes | 0.579 | 0.361 | 0.470 |" in text
    assert run_experiment(Call("mmd", given, report_only=True, beside_code=True), worker=stub) == 0
    assert "same meshes" not in (tmp_path / "out" / "mmd.md").read_text(), "no MMD is known at 3,000"


def test_mmd_is_compared_by_ratio(tmp_path, stub, options) -> None:
    run_experiment(Call("mmd", options()), worker=stub)
    proposed = json.loads((tmp_path / "out" / "mmd.json").read_text())["rows"][1]
    assert proposed["cells"]["airplane"]["to_baseline"]["ratio"] == pytest.approx(0.6 / 0.7)
    assert "(x 0.86)" in (tmp_path / "out" / "mmd.md").read_text()


def test_quoted_rows_are_marked_and_never_trained(tmp_path, stub, monkeypatch, capsys, options) -> None:
    table, quoted = TABLES["kato"], [row for row in TABLES["pascal"].rows if row.variant is None]
    monkeypatch.setitem(TABLES, "kato", dataclasses.replace(table, rows=(*quoted, *table.rows)))
    assert run_experiment(Call("kato", options()), worker=stub) == 0
    text = (tmp_path / "out" / "kato.md").read_text()
    assert "| CSDM | paper, quoted from Kar et al. 2015 (voxeliser not stated) | 0.398 | 0.398 |" in text
    assert "| CMR | paper, quoted from Kanazawa et al. 2018 (voxeliser not stated) | 0.460 | 0.460 |" in text
    assert {run["variant"] for run in json.loads((tmp_path / "out" / "kato.json").read_text())["runs"]} == {
        "vanilla",
        "proposed",
    }


def test_report_only_takes_what_is_there(report, tmp_path, stub) -> None:
    given = Options(Path("nowhere"), tmp_path / "out")
    assert [run.category for run in found_runs(TABLES["kato"], given)] == ["airplane"] * 6 + ["chair"] * 6
    assert run_experiment(Call("kato", given, report_only=True), worker=stub) == 0
    again = json.loads((tmp_path / "out" / "kato.json").read_text())
    ours = [[row["cells"][c] for c in ("airplane", "mean")] for row in report["rows"]]
    theirs = [[row["cells"][c] for c in ("airplane", "mean")] for row in again["rows"] if row["label"] != "VPL"]
    assert ours == theirs
    for path in (tmp_path / "out" / "runs").glob("*/*/test.json"):  # trained with a relative --data, elsewhere
        values = json.loads(path.read_text())
        path.write_text(json.dumps(values | {"config": values["config"] | {"data": "../data"}}))
    assert len(read_results(found_runs(TABLES["kato"], given))) == 12
    with pytest.raises(ValueError, match="no result for the table bins"):
        run_experiment(Call("bins", given, report_only=True), worker=stub)


def test_different_lengths_of_training_are_said(tmp_path, stub, options) -> None:
    for method, iterations in (("vanilla", 6), ("proposed", 8)):
        run_experiment(Call("kato", options(methods=(method,), iterations=iterations)), worker=stub)
    run_experiment(Call("kato", Options(Path("d"), tmp_path / "out"), report_only=True), worker=stub)
    assert (
        "not all trained alike: 6 iterations of batch 4, 8 iterations of batch 4"
        in (tmp_path / "out" / "kato.md").read_text()
    )


def test_the_table_on_the_terminal_is_aligned_and_says_how_long_ours_were_trained(stub, capsys, options) -> None:
    run_experiment(Call("kato", options(iterations=5)), worker=stub)
    header, *rows, reference, trained = capsys.readouterr().out.splitlines()
    assert reference.startswith("paper: on its own data")
    assert trained == "here: trained for 5 iterations of batch 4"
    starts = [match.start() for match in re.finditer(r"\S+", header)]
    assert len(starts) == 3 and len(rows) >= 4
    for row in rows:
        assert all(row[start - 2 : start] == "  " and row[start] != " " for start in starts[1:]), row


def test_a_page_receives_its_table(report, tmp_path) -> None:
    page = tmp_path / "results.md"
    page.write_text("Before.\n\n<!-- table: kato -->\nold\n<!-- end: kato -->\n\nAfter.\n")
    formats.embed(page, report)
    formats.embed(page, report)
    text = page.read_text()
    assert text.startswith("Before.\n\n<!-- table: kato -->\n| method |")
    assert text.endswith("<!-- end: kato -->\n\nAfter.\n")
    assert text.count("| Proposed | paper") == 1
    assert "old" not in text
    page.write_text("nothing")
    with pytest.raises(ValueError, match="must have the lines '<!-- table: kato -->'"):
        formats.embed(page, report)


def test_names_in_results_are_no_html_and_end_no_block(report, tmp_path, stub, options) -> None:
    report = copy.deepcopy(report)
    report["runs"][0] |= {"commit": "<b>\n|", "general_command": "python --pretrained 'a\n```\n<script>'"}
    text = formats.to_markdown(report)
    assert "| &lt;b&gt; \\| |\n" in text and "\n````sh\npython --pretrained 'a\n```\n<script>'" in text
    (tmp_path / "out/runs/airplane").rename(tmp_path / "out/runs/<script>\x1b")
    with pytest.raises(ValueError, match=r"is no folder of a category: category must be a plain name"):
        run_experiment(Call("kato", options(categories=()), report_only=True), worker=stub)


def test_calls_that_make_no_sense(options) -> None:
    with pytest.raises(ValueError, match="no table 'katoo'; choose one of kato, prgan"):
        run_experiment(Call("katoo", options()))
    with pytest.raises(ValueError, match="jobs must be"):
        run_experiment(Call("kato", options(), jobs=0))
    with pytest.raises(ValueError, match="give one of them"):
        run_experiment(Call("kato", options(), report_only=True, overwrite=True))
    with pytest.raises(ValueError, match="whatever settings they have; leave --set out"):
        run_experiment(Call("kato", options(changes=("lambda_prior=0",)), report_only=True))


def test_a_page_without_a_place_is_noticed_before_anything_is_trained(tmp_path, stub, options) -> None:
    page = tmp_path / "results.md"
    page.write_text("<!-- table: bins -->\n<!-- end: bins -->\n")
    with pytest.raises(ValueError, match="must have the lines '<!-- table: kato -->'"):
        run_experiment(Call("kato", options(), page=page), worker=stub)
    with pytest.raises(FileNotFoundError):
        run_experiment(Call("kato", options(), page=tmp_path / "other.md"), worker=stub)
    assert not (tmp_path / "out").exists()


def test_a_damaged_result_is_named(tmp_path, stub, options) -> None:
    run_experiment(Call("kato", options()), worker=stub)
    (tmp_path / "out/runs/airplane/vanilla-seed0/test.json").write_text("{")
    with pytest.raises(ValueError, match=r"vanilla-seed0/test.json .* remove it"):
        run_experiment(Call("kato", options(), report_only=True), worker=stub)


def test_the_page_of_results_has_a_place_for_every_table(report, tmp_path) -> None:
    page = tmp_path / "results.md"
    shutil.copy(Path(__file__).parents[3] / "docs" / "results.md", page)
    for name in TABLES:
        formats.embed(page, report | {"table": name})
    assert page.read_text().count("| Proposed | paper (kato18) | 0.565 |") == len(TABLES)
