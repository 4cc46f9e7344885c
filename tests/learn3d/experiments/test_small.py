"""Every table of the paper in small: `learn3d experiment` from its command line to its reports.

Procedural airplanes in three layouts, small networks, two steps of batch 8: the figures say nothing, but each of the
runs is planned, trained, measured, shared between tables and reported as in the real thing. Runs in processes of
their own are in `test_runs`.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import stub_work

from learn3d import commands
from learn3d.data.layouts import Layout
from learn3d.experiments import experiment
from learn3d.experiments.tables import TABLES, VARIANTS
from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.runs import checkpoint

pytestmark = pytest.mark.slow

CATEGORY = "airplane"
PASCAL_SEEDS = 2
MEASURES = ("voxel_iou", "voxel_iou_kato19", "mmd", "mmd_paper", "chamfer_l1", "f_score")
SHARES = ("voxel_iou", "voxel_iou_kato19", "f_score")  # between 0 and 1
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
SMALLER = dict.fromkeys(VARIANTS, _SMALL) | {
    **{name: (*_SMALL, "bank_size=4") for name in VARIANTS if name.startswith("plus") or name == "kar-plus"},
    **{name: (*_SMALL, "warmup_steps=1") for name in VARIANTS if "schedule" in name or "shared" in name},
    "vpl": ("discriminator_channels=8", "encoder=preact-resnet18"),
    "kar-vpl": _VPL,
    "pascal-vpl": (*_VPL, "generator=cube-conv"),
    **dict.fromkeys(("pascal-baseline", "pascal-proposed"), _SMALL[:1]),
    "pascal-plus": (_SMALL[0], "bank_size=4"),
    "prgan": ("discriminator_channels=4,8,16,32", "generator_channels=16,8,4,1"),
}


@dataclass(frozen=True)
class Outcome:
    """A call of the command, and its report."""

    status: int
    said: str
    text: str

    def rows(self, label: str) -> dict[str, list[str]]:
        """The rows of a method in all tables of the report, by their second cell."""
        rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in self.text.splitlines()]
        return {row[1]: row[2:] for row in rows if row[0] == label}


@dataclass(frozen=True)
class Laboratory:
    """A folder with data and runs."""

    folder: Path

    @property
    def runs(self) -> Path:
        return self.folder / "out" / "runs" / CATEGORY

    def call(self, table: str) -> Outcome:
        """Make a table as its user would: `learn3d experiment TABLE ...`."""
        variants = [row.variant for row in TABLES[table].rows.values() if row.variant]
        words = [table, "--data", self.folder / TABLES[table].layout, "--output", self.folder / "out"]
        words += ["--category", CATEGORY, "--iterations", 2, "--batch-size", 8, "--jobs", 2, "--threads", 1]
        words += ["--seeds", PASCAL_SEEDS if table == "pascal" else 1]
        words += ["--set", "max_val_images=6", "log_every=1"]
        words += ["precision=fp32"]
        words += [f"{variant}:{change}" for variant in variants for change in SMALLER[variant]]
        status, _, said = call_tool("experiment", *words)
        return Outcome(status, said, (self.folder / "out" / f"{table}.md").read_text())

    def results(self, variant: str) -> list[dict[str, Any]]:
        """The stored results of a variant, of all seeds."""
        return [json.loads((p / "test.json").read_text()) for p in sorted(self.runs.glob(f"{variant}-seed?"))]


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
    for layout in DATA:
        config = DatasetConfig(output=folder / layout, category=CATEGORY, layout=layout, **DATA[layout])
        make_dataset(config, progress=False)
    yield Laboratory(folder)
    shutil.rmtree(folder / "out", ignore_errors=True)


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
def test_every_row_is_trained_measured_and_reported(
    laboratory: Laboratory, outcomes: dict[str, Outcome], name: str
) -> None:
    outcome, table = outcomes[name], TABLES[name]
    assert outcome.status == 0, outcome.said
    assert "Missing" not in outcome.text
    for label, row in table.rows.items():
        lines = outcome.rows(label)
        assert (f"paper ({row.about})" in lines) == bool(row.figures)
        if row.variant is None:
            assert len(lines) == 1, "a quoted row is not measured"
            continue
        results = laboratory.results(row.variant)
        assert len(results) == (PASCAL_SEEDS if name == "pascal" else 1)
        for result in results:
            values = [result[measure] for measure in MEASURES]
            assert all(math.isfinite(value) and value >= 0 for value in values), label
            assert all(result[measure] <= 1 for measure in SHARES), label
            assert result["voxel_iou"] > 0, "even an untrained shape overlaps with an airplane"
            assert result["iterations"] == 2 * VARIANTS[row.variant].batch_divisor
        measure = "mmd" if name == "mmd" else "kato18"
        mean = sum(result[table.measure] for result in results) / len(results)
        cell, of_all = lines[f"here ({measure})"]
        assert cell == of_all and cell.startswith(f"{mean:.3f}"), label
        if name != "mmd":
            low, high = map(float, re.search(r"\[(.*), (.*)\]", cell).groups())
            assert low - 1e-3 <= mean <= high + 1e-3
            assert ("±" in cell) == (name == "pascal")
        in_list = outcome.rows(f"{CATEGORY}/{row.variant}-seed0")[f"step {results[0]['step']}"]
        assert f"{results[0]['chamfer_l1']:.4f}" in in_list


def test_settings_of_rows_reach_their_runs(laboratory: Laboratory, outcomes: dict[str, Outcome]) -> None:
    def metadata(variant: str, name: str) -> checkpoint.Metadata:
        return checkpoint.load_metadata(laboratory.runs / f"{variant}-seed0" / f"{name}.safetensors")

    counts = {widths: metadata(f"bins-{widths}", "best").info.num_views for widths in VIEW_CLASSES}
    assert counts == VIEW_CLASSES
