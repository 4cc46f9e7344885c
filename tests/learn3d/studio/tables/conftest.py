"""Fixtures of the tests of tables: requests, and reports of results that nobody has trained."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import stub_work

from learn3d.studio.tables import experiment
from learn3d.studio.tables.experiment import run_experiment
from learn3d.studio.tables.plan import Request


@pytest.fixture
def request_for(tmp_path: Path) -> Callable[..., Request]:
    """A request for a table with two methods on one category, with changes."""

    def make(table: str = "kato", **changes: object) -> Request:
        given = {
            "category": "airplane",
            "methods": ("vanilla", "proposed"),
            "iterations": 6,
            "batch_size": 4,
        }
        return Request(table, tmp_path / "data", tmp_path / "out", **(given | changes))

    return make


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """`run_experiment` with untrained results, in this process."""
    monkeypatch.setattr(experiment, "run_tasks", stub_work.run_tasks_here)
    return functools.partial(run_experiment, work=stub_work.work)


@pytest.fixture
def read_report(tmp_path: Path) -> Callable[[str], str]:
    """The report of a table in `tmp_path / "out"`."""
    return lambda table="kato": (tmp_path / "out" / f"{table}.md").read_text()


@pytest.fixture
def change_result(tmp_path: Path) -> Callable[[Callable[[dict], dict]], None]:
    """Adds to the stored result of a run of the method "proposed"."""

    def change(make: Callable[[dict], dict]) -> None:
        path = tmp_path / "out/runs/airplane/proposed-seed0/test.json"
        stored = json.loads(path.read_text())
        path.write_text(json.dumps(stored | make(stored)))

    return change
