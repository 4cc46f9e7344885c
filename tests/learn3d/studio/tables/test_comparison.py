"""Tables and their reports: the paper's figures beside ours, with their intervals."""

from __future__ import annotations

import dataclasses
import json
import math
import re

import numpy as np
import pytest
import stub_work

from learn3d.presets import PRESETS
from learn3d.runs.baselines import measure_baselines
from learn3d.studio.tables import comparison, experiment
from learn3d.studio.tables.comparison import (
    ABOUT_BASELINES,
    percentile_interval,
    resampled_means,
)
from learn3d.studio.tables.experiment import describe_tables, run_experiment
from learn3d.studio.tables.plan import plan_runs
from learn3d.studio.tables.tables import MEAN, TABLES, VARIANTS
from learn3d.tasks import Workers

NUMBER = r"-?\+?\d\.\d{3}"


def test_printed_means_agree_with_the_printed_rows() -> None:
    count = 0
    for label, row in [item for table in TABLES.values() for item in table.rows.items()]:
        if len(printed := dict(row.printed)) > 1 and MEAN in printed:
            mean = printed.pop(MEAN)
            assert np.mean(list(printed.values())) == pytest.approx(mean, abs=0.001), label
            count += 1
    assert count == 18


def test_rows_name_variants_and_baselines() -> None:
    used = {row.variant for table in TABLES.values() for row in table.rows.values() if row.variant}
    assert used == set(VARIANTS), "every variant is a row of a table"
    assert {variant.preset for variant in VARIANTS.values()} <= set(PRESETS)
    for table in TABLES.values():
        assert table.baseline in table.rows
        assert all(row.variant or row.printed for row in table.rows.values())
    assert TABLES["kar"].rows["Proposed"].variant in {
        row.variant for row in TABLES["bins"].rows.values()
    }
    assert "  w/o prior: without-prior, preset peng2020-kato, lambda_prior=0" in describe_tables()
    assert "  CSDM: quoted" in describe_tables()


def test_the_page_shows_our_figures_beside_the_papers(
    make, request_for, read_report, tmp_path, capsys
) -> None:
    """Objects have .40 to .48, and seeds differ by .01; the baseline has .1 less everywhere."""
    assert make(request_for(category="airplane,chair", seeds=3, workers=Workers(2))) == 0
    text = read_report()
    assert "| Proposed | paper (kato18) | 0.565 | 0.415 | 0.490 |" in text, (
        "the paper's mean over the same categories"
    )
    (line,) = (
        line for line in text.splitlines() if line.startswith("| Proposed | here (kato18) |")
    )
    value, half, low, high = map(float, re.findall(NUMBER, line)[:4])
    assert (value, half) == (0.45, round(4.302653 * 0.01 / math.sqrt(3), 3))
    assert 0.42 < low < 0.45 < high < 0.48
    assert "| Proposed | +0.100 ±0.000 [+0.100, +0.100] |" in text, (
        "paired: every object and every seed gains .1"
    )
    assert "| airplane/proposed-seed2 | step 6 | 6 | 4 | 120 | 0.4600 | 0.4100 |" in text
    assert "| 1.0 | 012345678 |" in text
    assert "learn3d train --preset peng2020-kato --data DATA --category CATEGORY" in text
    assert str(tmp_path) not in text
    tables = json.loads((tmp_path / "out" / "kato.json").read_text())
    assert all(
        f"| {' | '.join(row)} |" in text
        for name in ("main", "differences", "runs")
        for row in tables[name]
    )
    assert ["airplane/proposed-seed2", "val", "3", "0.2000", "-"] in tables["curves"]
    header, *rows = [line for line in capsys.readouterr().out.splitlines() if line]
    starts = [match.start() for match in re.finditer(r"\S+", header)]
    assert len(rows) == 6
    assert all(
        row[start - 2 : start] == "  " and row[start] != " " for row in rows for start in starts[1:]
    )


def test_baselines_stand_below_the_methods(
    tiny_folder, make, request_for, read_report, tmp_path, monkeypatch, capsys
) -> None:
    """They are measured once for a data set, and left out with a note if it is not here."""
    given = dataclasses.replace(request_for(), data=tiny_folder)
    assert make(given) == 0
    text, tables = read_report(), json.loads((tmp_path / "out/kato.json").read_text())
    for baseline in measure_baselines("kato", tiny_folder, "airplane"):
        (cells,) = [row for row in tables["main"] if row[0] == baseline.name]
        assert cells[1] == "here (voxels)" and cells[2].startswith(f"{baseline.voxel_iou:.3f} [")
        (difference,) = [row for row in tables["differences"] if row[0] == baseline.name]
        assert difference[1].startswith(f"{baseline.voxel_iou - 0.34:+.3f}")
    assert ABOUT_BASELINES in text
    monkeypatch.setattr(experiment, "measure_baselines", None)
    assert make(dataclasses.replace(given, seeds=2)) == 0
    assert "| Mean shape | here (voxels) |" in read_report(), "read from the output folder"
    path = tmp_path / "out/baselines/airplane.json"
    path.write_text(path.read_text().replace('"voxel_iou"', '"iou"'))
    with pytest.raises(ValueError, match=r"airplane.json has no baselines .* remove it"):
        make(given)
    path.unlink()
    make(request_for(report_only=True))
    assert "Mean shape" not in read_report()
    assert "no rows for the mean shape of airplane" in capsys.readouterr().err
    make(dataclasses.replace(given, table="mmd"))
    assert "Mean shape" not in read_report("mmd"), "that table compares codes"


def test_measures_that_disagree_are_named(make, request_for, read_report, change_result) -> None:
    make(request_for())
    assert "disagree" not in read_report(), "Chamfer-L1 and F-score are equal"
    change_result(lambda stored: {"chamfer_l1": 0.2, "f_score": 0.7})
    make(request_for(report_only=True))
    wanted = (
        "Measures disagree on airplane: voxel IoU and F-score for Proposed, Chamfer-L1 for "
        "Vanilla-AE."
    )
    assert wanted in read_report()


def test_both_checkpoints_the_angles_and_the_unclamped_iou_are_reported(
    tmp_path, make, request_for, read_report, change_result
) -> None:
    make(request_for())
    best = {"checkpoint": "run/best.safetensors", "step": 3, "voxel_iou": 0.5}
    more = {"angles": [[0, 0.9], [180, 0.7]], "voxel_iou_unclamped": 0.3}
    change_result(lambda stored: more | {"other": stored | best})
    make(request_for(report_only=True))
    tables = json.loads((tmp_path / "out/kato.json").read_text())
    networks = [row[1] for row in tables["runs"] if row[0] == "airplane/proposed-seed0"]
    assert networks == ["step 6 (last)", "step 3 (best)"]
    assert tables["angles"][1] == ["airplane/proposed-seed0", "0.9000", *["-"] * 11, "0.7000"]
    assert "| Proposed | here (kato18, without clamp) | 0.300 | 0.300 |" in read_report()
    assert "| Vanilla-AE | here (kato18, without clamp)" not in read_report(), "not known"


def test_a_mean_over_other_categories_is_in_parentheses(make, request_for, read_report) -> None:
    make(request_for("prgan", methods=("proposed",), category="airplane,lamp"))
    assert "| Proposed | paper (kato18) | 0.565 | - | (0.550) |" in read_report("prgan")


def test_mmd_is_compared_by_ratio(make, request_for, read_report) -> None:
    make(request_for("mmd"))
    assert "| Proposed | -0.100 (x 0.86) |" in read_report("mmd")


def test_results_on_different_objects_have_no_interval(
    make, request_for, read_report, change_result
) -> None:
    make(request_for())
    change_result(lambda stored: {"objects": [["another", 24, 0.4, 0.4], *stored["objects"][1:]]})
    make(request_for(report_only=True))
    assert "| Proposed | +0.100 | +0.100 |" in read_report()


def test_quoted_rows_are_shown_and_never_trained(
    tmp_path, make, monkeypatch, request_for, read_report
) -> None:
    table = TABLES["kato"]
    rows = {name: TABLES["pascal"].rows[name] for name in ("CSDM", "CMR")} | dict(table.rows)
    monkeypatch.setitem(TABLES, "kato", table._replace(rows=rows))
    assert make(request_for()) == 0
    assert (
        "| CSDM | paper (voxelizer not stated, quoted from Kar et al. 2015) | 0.398 | 0.398 |"
        in read_report()
    )
    assert (
        "| CMR | paper (voxelizer not stated, quoted from Kanazawa et al. 2018) | 0.460 | 0.460 |"
        in read_report()
    )
    assert len(list(tmp_path.glob("out/runs/*/*"))) == 2


def test_report_only_trains_nothing(make, request_for, read_report) -> None:
    make(request_for())
    before = read_report()
    assert make(request_for(seeds=2, report_only=True)) == 0
    assert "Missing: airplane/vanilla-seed1, airplane/proposed-seed1." in read_report()
    assert [line for line in before.splitlines() if " here " in line] == [
        line for line in read_report().splitlines() if " here " in line
    ]


def test_no_html_from_names_in_results() -> None:
    assert comparison._markdown([["a"], ["<b>\n|"]]).endswith("\n| &lt;b&gt; \\| |")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(
            ({name: value}, name)
            for name, value in {"iterations": "10", "images": True, "mmd": "low"}.items()
        ),
        *(
            ({name: value}, name)
            for name, value in {"versions": {"commit": 5}, "objects": {}}.items()
        ),
        ({"objects": [["a", 24, 10**200, None]]}, r"objects\.0"),
        ({"objects": [["a", 24, 0.5]]}, r"objects\.0"),
        ("{", "Invalid JSON"),
        ("[" * 99_999, "recursion"),
    ],
)
def test_damaged_results_are_named(changes, message: str, request_for) -> None:
    (run,) = plan_runs(request_for(methods=("proposed",)))
    run.config.output.mkdir(parents=True)
    stored = stub_work.result().model_dump()
    text = changes if isinstance(changes, str) else json.dumps(stored | changes)
    (run.config.output / "test.json").write_text(text)
    with pytest.raises(
        ValueError, match=rf"test.json is no measurement of a run .*{message}.*remove it"
    ):
        run_experiment(request_for(methods=("proposed",)), work=stub_work.fail_if_started)


def test_bootstrap_is_over_objects_not_images() -> None:
    """Ten objects that differ, each with 24 images all alike: the interval is that of ten values, not of 240."""
    means = np.linspace(0.1, 1.0, 10)
    low, high = percentile_interval(resampled_means([24 * means], [np.full(10, 24.0)]))
    error = means.std() / math.sqrt(10)
    assert (0.55 - low, high - 0.55) == pytest.approx((1.96 * error, 1.96 * error), rel=0.12)


def test_bootstrap_weighs_images_and_categories() -> None:
    one = resampled_means([np.array([3.0, 1.0])], [np.array([3.0, 2.0])])
    assert set(np.round(one, 6)) <= {1.0, 0.5, 0.8}, "mean over images: 3/3, 1/2 or 4/5"
    both = resampled_means(
        [np.array([1.0]), np.array([0.0, 0.0])], [np.array([1.0]), np.array([1.0, 1.0])]
    )
    assert np.all(both == 0.5), "then over categories, however many objects they have"
