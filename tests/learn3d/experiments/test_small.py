"""Every table of the paper in small: `learn3d experiment` from its command line to its reports.

Procedural airplanes in three layouts, small networks, two steps of batch 8: the figures say nothing, but each of the
runs is planned, trained, measured, shared between tables and reported as in the real thing. Then the one preset that
no table has, on two categories. (Runs in processes of their own are the matter of `test_runs`.)
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import stub_work
import trimesh

from learn3d import commands
from learn3d.data.layouts import Layout
from learn3d.experiments import experiment
from learn3d.experiments.tables import TABLES, VARIANTS
from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.runs import checkpoint

pytestmark = pytest.mark.slow

CATEGORY = "airplane"
PASCAL_SEEDS = 2
MEASURES = ("kato18", "kato19", "mmd", "mmd_paper", "chamfer_l1", "f_score")
SHARES = ("kato18", "kato19", "f_score")  # between 0 and 1
VIEW_CLASSES = {"60x60": 6, "30x30": 24, "20x20": 54, "20x15": 72, "15x20": 72, "15x15": 96, "10x10": 216}

#: What makes data of each layout small: 4 objects to train on and 2 to test on, from as many views as an MMD needs.
DATA: dict[Layout, dict[str, Any]] = {
    "kato": {"procedural": 7, "test": 2, "val": 1},
    "kar": {"procedural": 7, "test": 2, "val": 1, "views": 20},
    "pascal3d": {"procedural": 6, "val": 2, "views": 6},
}
_SMALL = ("encoder=conv-small", "generator=sphere-small")
_VPL = ("discriminator_channels=8", "image_size=64", "silhouette_size=64")
#: --set of every method: its smallest networks.
SMALLER = {
    "vanilla": _SMALL,
    "proposed": _SMALL,
    "without-prior": _SMALL,
    "without-adversarial": _SMALL,
    "without-smoothness": _SMALL,
    "multi-view": _SMALL,
    **dict.fromkeys(
        ("plus", "plus-without-symmetry", "plus-without-novel-views", "kar-plus"), (*_SMALL, "bank_size=4")
    ),
    **{f"{name}-schedule-symmetry": (*_SMALL, "warmup_steps=1") for name in ("vanilla", "proposed")},
    **dict.fromkeys(("proposed-schedule", "vanilla-shared", "proposed-shared"), (*_SMALL, "warmup_steps=1")),
    **{f"single-{name}": _SMALL for name in ("vanilla", "proposed", "plus")},
    "kar-vanilla": _SMALL,
    **{f"bins-{widths}": _SMALL for widths in VIEW_CLASSES},
    "vpl": ("discriminator_channels=8", "encoder=preact-resnet18"),
    "kar-vpl": _VPL,
    "pascal-vpl": (*_VPL, "generator=cube-conv"),
    "pascal-baseline": _SMALL[:1],
    "pascal-proposed": _SMALL[:1],
    "pascal-plus": (_SMALL[0], "bank_size=4"),
    "proposed-fp32": _SMALL,
    "proposed-bf16": _SMALL,
    "prgan": ("discriminator_channels=4,8,16,32", "generator_channels=16,8,4,1"),
}


@dataclass(frozen=True)
class Outcome:
    """What a call of the command left behind."""

    status: int
    said: str
    report: dict[str, Any]
    files: dict[str, str]  # the report's files by suffix

    def cell(self, label: str, column: str = CATEGORY) -> dict[str, Any]:
        """What the report has of a row and column."""
        return next(row for row in self.report["rows"] if row["label"] == label)["cells"][column]


@dataclass(frozen=True)
class Laboratory:
    """A folder with data and runs."""

    folder: Path

    @property
    def runs(self) -> Path:
        return self.folder / "out" / "runs" / CATEGORY

    def call(self, table: str) -> Outcome:
        """Make a table as its user would: `learn3d experiment TABLE ...`."""
        variants = [variant for variant in TABLES[table].rows.values() if variant]
        words = [table, "--data", self.folder / TABLES[table].layout, "--output", self.folder / "out"]
        words += ["--category", CATEGORY, "--iterations", 2, "--batch-size", 8, "--jobs", 2, "--threads", 1]
        words += ["--seeds", PASCAL_SEEDS if table == "pascal" else 1]
        words += ["--set", "max_val_images=6", "log_every=1"]
        words += ["precision=fp32"] if table != "precision" else []
        words += [f"{variant}:{change}" for variant in variants for change in SMALLER[variant]]
        status, _, said = call_tool("experiment", *words)
        paths = {suffix: self.folder / "out" / f"{table}.{suffix}" for suffix in ("json", "md")}
        texts = {suffix: path.read_text() for suffix, path in paths.items()}
        return Outcome(status, said, json.loads(texts["json"]), texts)


def call_tool(name: str, *words: object) -> tuple[int, str, str]:
    """Call `learn3d`; its exit status and what it wrote to both outputs."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["learn3d", name, *map(str, words)])
        patch.setattr(experiment, "run_tasks", stub_work.run_tasks_here)
        status = commands.main()
    return status, out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laboratory]:
    """Data of each layout that a table takes; the runs are removed at the end, as checkpoints are large."""
    folder = tmp_path_factory.mktemp("laboratory")
    for layout, category in [*((layout, CATEGORY) for layout in DATA), ("kar", "chair")]:
        config = DatasetConfig(output=folder / layout, category=category, layout=layout, **DATA[layout])
        make_dataset(config, progress=False)
    yield Laboratory(folder)
    for name in ("out", "conditional"):
        shutil.rmtree(folder / name, ignore_errors=True)


@pytest.fixture(scope="module")
def outcomes(laboratory: Laboratory) -> dict[str, Outcome]:
    """Every table, made once, one after the other into the same folder.

    VPL's checkpoints, half a gigabyte each, go as soon as they are measured: figures are made without them.
    """
    made = {}
    for name in TABLES:
        made[name] = laboratory.call(name)
        for path in laboratory.runs.glob("*vpl-seed*/*.safetensors"):
            path.unlink()
    return made


@pytest.mark.parametrize("name", TABLES)
def test_every_row_is_trained_and_measured(outcomes: dict[str, Outcome], name: str) -> None:
    outcome, table = outcomes[name], TABLES[name]
    assert outcome.status == 0, outcome.said
    assert outcome.report["missing"] == []
    assert [row["label"] for row in outcome.report["rows"]] == list(table.rows)
    for label, variant in table.rows.items():
        cell = outcome.cell(label)
        if variant is None:
            assert "values" not in cell, "a quoted row is not measured"
            continue
        values, intervals = cell["values"], cell["interval_objects"]
        assert set(values) == set(MEASURES), label
        assert all(math.isfinite(value) and value >= 0 for value in values.values()), label
        assert all(values[measure] <= 1 for measure in SHARES), label
        assert values["kato18"] > 0, "even an untrained shape overlaps with an airplane"
        for measure in ("kato18", "kato19"):
            assert intervals[measure][0] - 1e-6 <= values[measure] <= intervals[measure][1] + 1e-6, label
        assert outcome.cell(label, "mean")["values"] == pytest.approx(values)
        assert cell["iterations"] == [2 * VARIANTS[variant].batch_divisor]
        assert cell["seeds"] == list(range(PASCAL_SEEDS if name == "pascal" else 1))
        assert ("to_baseline" in cell) == (label != table.baseline)


@pytest.mark.parametrize("name", TABLES)
def test_all_files_of_a_report_agree(outcomes: dict[str, Outcome], name: str) -> None:
    outcome = outcomes[name]
    rows = markdown_rows(outcome.files["md"])
    for row in outcome.report["rows"]:
        wanted = ["mmd"] if name == "mmd" else ["kato18", "kato19"]
        for measure in wanted if row["variant"] else []:
            value = row["cells"][CATEGORY]["values"][measure]
            assert row_of(rows, row["label"], f"here ({measure})")[2].split(" ")[0] == f"{value:.3f}"
    for run in outcome.report["runs"]:
        values = [f"{run[measure]:.4f}" for measure in MEASURES]
        assert any(row[0] == run["run"] and row[6:12] == values for row in rows), "in the list of runs, too"


def test_a_second_call_trains_nothing(laboratory: Laboratory, outcomes: dict[str, Outcome]) -> None:
    def times() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in laboratory.runs.rglob("*") if path.is_file()}

    before = times()
    for name, first in outcomes.items():
        again = laboratory.call(name)
        count = len(first.report["runs"])
        assert (again.status, again.files) == (0, first.files)
        assert f"{name}: {count} runs, {count} of them done;" in again.said
    assert times() == before


def test_tables_share_their_runs(laboratory: Laboratory, outcomes: dict[str, Outcome]) -> None:
    seeds = {name: PASCAL_SEEDS if name in TABLES["pascal"].rows.values() else 1 for name in VARIANTS}
    folders = {f"{name}-seed{seed}" for name in VARIANTS for seed in range(seeds[name])}
    assert {path.name for path in laboratory.runs.iterdir()} == folders
    assert all((path / "log.txt").read_text().count("training: ") == 1 for path in laboratory.runs.iterdir())
    cells = [outcomes[name].cell("Proposed") for name in ("kato", "prgan", "ablation", "mmd", "multi-view")]
    assert all(cell["values"] == cells[0]["values"] for cell in cells)
    assert outcomes["kar"].cell("Proposed")["values"] == outcomes["bins"].cell("15x20 degrees")["values"]


def test_bins_decide_the_number_of_view_classes(laboratory: Laboratory, outcomes: dict[str, Outcome]) -> None:
    counts = {}
    for label, variant in TABLES["bins"].rows.items():
        metadata = checkpoint.load_metadata(laboratory.runs / f"{variant}-seed0" / "best.safetensors")
        counts[label.removesuffix(" degrees")] = metadata.info.num_views
    assert counts == VIEW_CLASSES
    assert sorted(counts.values()) == list(counts.values()), "finer and finer"
    assert outcomes["bins"].report["missing"] == []


def test_losses_that_an_ablation_turns_off_are_not_computed(
    laboratory: Laboratory, outcomes: dict[str, Outcome], read_metrics: Callable[[Path], list[dict[str, Any]]]
) -> None:
    off = {"without-prior": {"prior"}, "without-adversarial": {"classification", "confusion"}}
    off |= {"proposed": set(), "without-smoothness": {"smoothness"}}
    logged = {}
    for name in off:
        lines = read_metrics(laboratory.runs / f"{name}-seed0")
        logged[name] = {key for line in lines if line["split"] == "train" for key in line} - {"split", "step"}
    for name, terms in off.items():
        assert logged["proposed"] - logged[name] == terms, name
    assert outcomes["ablation"].cell("w/o prior")["paper"] == 0.552


def test_the_precision_is_the_rows(laboratory: Laboratory, outcomes: dict[str, Outcome]) -> None:
    for label, variant in TABLES["precision"].rows.items():
        metadata = checkpoint.load_metadata(laboratory.runs / f"{variant}-seed0" / "last.safetensors")
        assert label.endswith(metadata.fingerprint.precision)
    fp32, bf16 = (outcomes["precision"].cell(label)["values"]["kato18"] for label in TABLES["precision"].rows)
    assert fp32 != bf16


def test_pascal_has_seeds_and_quoted_rows(laboratory: Laboratory, outcomes: dict[str, Outcome]) -> None:
    outcome = outcomes["pascal"]
    table = markdown_rows(outcome.files["md"])
    assert row_of(table, "CSDM", "paper, quoted from Kar et al. 2015 (voxeliser not stated)")[2:] == ["0.398", "0.398"]
    assert row_of(table, "CMR", "paper, quoted from Kanazawa et al. 2018 (voxeliser not stated)")[2] == "0.460"
    for label in ("VPL", "Baseline", "Proposed", "Plus"):
        cell = outcome.cell(label)
        values = cell["by_seed"]["kato18"]
        assert len(values) == PASCAL_SEEDS and values[0] != values[1]
        assert cell["values"]["kato18"] == pytest.approx(sum(values) / 2)
        half = 12.7062 * abs(values[0] - values[1]) / 2  # Student's t of one degree of freedom
        assert cell["interval_seeds"]["kato18"] == pytest.approx(
            [cell["values"]["kato18"] - half, cell["values"]["kato18"] + half], abs=1e-4
        )
        assert f" ±{half:.3f} [" in row_of(table, label, "here (kato18)")[2]
    assert {run["checkpoint"] for run in outcome.report["runs"] if run["variant"] != "pascal-vpl"} == {"best"}


def test_the_mmd_is_the_entry_of_its_table(outcomes: dict[str, Outcome]) -> None:
    vanilla, proposed = (outcomes["mmd"].cell(label) for label in ("Vanilla-AE", "Proposed"))
    ratio = proposed["values"]["mmd"] / vanilla["values"]["mmd"]
    assert proposed["to_baseline"]["ratio"] == pytest.approx(ratio)
    assert f"(x {ratio:.2f})" in outcomes["mmd"].files["md"]


def test_a_class_conditional_model_goes_from_meshes_to_meshes(laboratory: Laboratory, tmp_path: Path) -> None:
    """make_dataset (two categories) -> train -> evaluate -> reconstruct, each by its command."""
    data, run = laboratory.folder / "kar", laboratory.folder / "conditional"
    words = ["--preset", "kato2019-kar", "--class-conditional", "--data", data, "--category", f"{CATEGORY},chair"]
    words += ["--output", run]
    words += ["--iterations", 2, "--batch-size", 4, "--precision", "fp32", "--threads", 1, "--max-val-images", 6]
    words += [word for change in _VPL for word in f"--{change.replace('_', '-')}".split("=")]
    status, _, said = call_tool("train", *words)
    assert status == 0, said
    assert checkpoint.load_metadata(run / "last.safetensors").info.num_classes == 2
    tensors, _ = checkpoint.load(run / "last.safetensors")
    (name,) = (name for name in tensors if name.startswith("network.discriminator.classes.") and "original" in name)
    assert tensors[name].shape[1] == 2, "the discriminator is told one of two classes"

    status, _, said = call_tool("evaluate", run, "--json", tmp_path / "figures.json")
    assert status == 0, said
    results = json.loads((tmp_path / "figures.json").read_text())["results"]
    assert [(result["category"], result["images"]) for result in results] == [(CATEGORY, 40), ("chair", 40)]
    for result in results:
        assert 0 < result["voxel_iou_kato18"] <= 1 and 0 < result["voxel_iou_kato19"] <= 1
        assert 0 <= result["f_score"] <= 1 and math.isfinite(result["chamfer_l1"] + result["mmd"])

    words = ["--run", run, "--output", tmp_path, "--data", data, "--category", "chair", "--indices", 0, 25]
    status, out, said = call_tool("reconstruct", *words, "--frames", 2, "--image-size", 32, "--format", "ply")
    assert status == 0, said
    meshes = [trimesh.load(path) for path in out.split() if path.endswith(".ply")]
    assert len(meshes) == 2 and len(out.split()) == 6
    assert all(mesh.is_watertight and abs(mesh.vertices).max() < 2 for mesh in meshes)


def markdown_rows(text: str) -> list[list[str]]:
    """The cells of all tables of a Markdown report, without the lines that part their headers."""
    rows = [line.strip("|").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in row] for row in rows]


def row_of(rows: list[list[str]], label: str, kind: str) -> list[str]:
    """The row of a method that is of a kind: "paper ...", "here (kato18)" ..."""
    current = ""
    for row in rows:
        current = row[0] or current
        if (current, row[1]) == (label, kind):
            return row
    raise AssertionError(f"no row {kind!r} of {label!r}")
