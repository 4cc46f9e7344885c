"""Every table of the paper in small: `learn3d experiment` from its command line to its reports.

Procedural airplanes in three layouts, small networks, two steps of batch 8: the figures mean
nothing, but every run is planned, trained, measured, shared between tables and reported. Runs in
processes of their own are in `test_runs`.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import stub_work

from learn3d import commands
from learn3d.studio.make_data.render import DatasetConfig, make_dataset
from learn3d.studio.poses.options import PoseOptions
from learn3d.studio.tables import experiment
from learn3d.studio.tables.tables import BATCH_DIVISOR, TABLES, VARIANTS

pytestmark = pytest.mark.slow

PASCAL_SEEDS = 2
#: Small data of each layout: 4 objects to train on and 2 to test on, with enough views for MMD.
DATA = {
    "kato": {"procedural": 7, "test": 2, "val": 1},
    "kar": {"procedural": 7, "test": 2, "val": 1, "views": 20},
    "pascal3d": {"procedural": 6, "val": 2, "views": 6},
}
QUICK_POSES = {"steps": 5, "restarts": 1, "repeats": 1}
_SMALL = ("encoder=conv-small", "generator=sphere-small")
#: --set of every variant: its smallest networks.
SMALLER = dict.fromkeys(VARIANTS, _SMALL) | {
    **{
        name: (*_SMALL, "bank_size=4")
        for name in VARIANTS
        if name.startswith("plus") or name == "kar-plus"
    },
    **{
        name: (*_SMALL, "warmup_steps=1")
        for name in VARIANTS
        if "schedule" in name or "shared" in name
    },
    "vpl": (*_SMALL, "discriminator_channels=8"),
    **dict.fromkeys(("pascal-baseline", "pascal-proposed"), _SMALL[:1]),
    "pascal-plus": (_SMALL[0], "bank_size=4"),
    "prgan": ("discriminator_channels=4,8,16,32", "generator_channels=16,8,4,1"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Data of each layout, and all tables, each made by its command into the folder `out`.

    VPL's checkpoints of half a gigabyte are removed as soon as they are measured, the other runs
    at the end.
    """
    folder = tmp_path_factory.mktemp("tables")
    for layout, options in DATA.items():
        make_dataset(
            DatasetConfig(output=folder / layout, category="airplane", layout=layout, **options)
        )
    for name, table in TABLES.items():
        words = f"{name} --data {folder / table.layout} --output {folder / 'out'} --category airplane --iterations 2 "
        words += f"--batch-size 8 --jobs 2 --threads 1 --seeds {PASCAL_SEEDS if name == 'pascal' else 1} "
        words += "--set max_val_images=6 log_every=1 precision=fp32"
        variants = [row.variant for row in table.rows.values() if row.variant]
        smaller = [f"{variant}:{change}" for variant in variants for change in SMALLER[variant]]
        with (
            pytest.MonkeyPatch.context() as patch,
            contextlib.redirect_stderr(io.StringIO()) as said,
        ):
            patch.setattr("sys.argv", ["learn3d"])
            patch.setattr(experiment, "run_tasks", stub_work.run_tasks_here)
            patch.setattr(experiment, "PoseOptions", functools.partial(PoseOptions, **QUICK_POSES))
            assert commands.main("experiment", *words.split(), *smaller) == 0, said.getvalue()
        for path in folder.glob("out/runs/*/*vpl-seed*/*.safetensors"):
            path.unlink()
    yield folder
    shutil.rmtree(folder / "out", ignore_errors=True)


@pytest.mark.parametrize("name", TABLES)
def test_every_row_is_trained_measured_and_reported(folder: Path, name: str) -> None:
    assert "Missing" not in (folder / "out" / f"{name}.md").read_text()
    for variant in filter(None, (row.variant for row in TABLES[name].rows.values())):
        files = sorted(folder.glob(f"out/runs/airplane/{variant}-seed?/test.json"))
        results = [json.loads(file.read_text()) for file in files]
        assert len(results) == (PASCAL_SEEDS if name == "pascal" else 1)
        steps = 2 * (BATCH_DIVISOR if VARIANTS[variant].small_batches_of else 1)
        for result in results:
            assert result["iterations"] == result["curve"][-1][1] == steps
            assert result["voxel_iou"] > 0, "even an untrained shape overlaps with an airplane"
            assert result["mmd"] > 0 and result["mmd_floor"] > 0
