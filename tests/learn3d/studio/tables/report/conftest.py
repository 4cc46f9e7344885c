"""Two short runs of tiny networks, and the page about them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from learn3d.config import TrainConfig
from learn3d.training import train

PRESETS = {"proposed": "peng2020-kato", "vanilla": "peng2020-kato-vanilla"}
RATES = {"proposed": 1e-4, "vanilla": 0.03}  # so that their shapes differ


@pytest.fixture(scope="module")
def runs(
    tiny_run: Callable[..., TrainConfig], tmp_path_factory: pytest.TempPathFactory
) -> list[Path]:
    """Folders of runs of two methods on the tiny data."""
    pytest.importorskip("plotly")
    folders = [tmp_path_factory.mktemp("runs") / name for name in PRESETS]
    for folder in folders:
        train(tiny_run(folder, preset=PRESETS[folder.name], learning_rate=RATES[folder.name]))
    return folders


@pytest.fixture(scope="module")
def page(runs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report on the three objects of the training split, of which two have shapes; one run has a name for HTML."""
    from learn3d.studio.tables.report import write_report

    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(runs, path, labels=["</script><b>one", "two"], split="train", objects=2)
    return path
