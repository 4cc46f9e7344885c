"""What tests of the tables share: options and a report."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import stub_work

from learn3d.experiments import experiment
from learn3d.experiments.experiment import Call, run_experiment
from learn3d.experiments.plan import Options


@pytest.fixture
def options(tmp_path: Path) -> Callable[..., Options]:
    """Options of two methods on one category, with changes."""

    def make(**changes: object) -> Options:
        given = {"categories": ("airplane",), "methods": ("vanilla", "proposed"), "iterations": 6, "batch_size": 4}
        return Options(tmp_path / "data", tmp_path / "out", **(given | changes))

    return make


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Makes a table of results that nobody has trained, in this process."""
    monkeypatch.setattr(experiment, "run_tasks", stub_work.carry_out_here)
    return functools.partial(run_experiment, work=stub_work.work)


@pytest.fixture
def report(tmp_path: Path, make: Callable[..., int]) -> dict:
    """The report of a table of two categories and three seeds in `tmp_path / "out"`."""
    asked = {"categories": ("airplane", "chair"), "methods": ("vanilla", "proposed"), "iterations": 6, "batch_size": 4}
    assert make(Call("kato", Options(tmp_path / "data", tmp_path / "out", seeds=3, **asked), jobs=2)) == 0
    return json.loads((tmp_path / "out" / "kato.json").read_text())
