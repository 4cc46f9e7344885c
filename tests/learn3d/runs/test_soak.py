"""A day of training scaled down: 10,000 steps use no more at the end than at the beginning.

Other programs make the CPU time of a step longer, never shorter: its least is compared, and a second attempt allowed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from children import environment

from learn3d.config import config_to_dict

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc of Linux"),
]

STEPS, EVERY = 10_000, 100
# bytes between the middles of the first and the last third; a leaked scalar per step: 3e6
MEMORY_GROWTH = 1e6
TIME_GROWTH = 1.3


def soak(tiny_run, tiny_folder: Path, folder: Path) -> list[dict[str, float]]:
    for path in tiny_folder.iterdir():
        with np.load(path) as archive:
            np.savez(folder / path.name, archive["arr_0"])
    often = {
        "log_every": 10,
        "validate_every": 500,
        "checkpoint_every": 500,
        "pictures_every": 1000,
    }
    config = tiny_run(folder / "run", data=folder, iterations=STEPS, **often)
    script = Path(__file__).parents[2] / "data" / "soak.py"
    command = [sys.executable, str(script), json.dumps(config_to_dict(config)), str(EVERY)]
    ended = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=900)
    assert ended.returncode == 0, ended.stderr
    return [json.loads(line) for line in ended.stdout.splitlines()]


def thirds(of: Callable[[list[float]], float], values: list[float]) -> tuple[float, float]:
    """`of` (median or min) of the first third and of the last third, without the first tenth, which warms up."""
    values = values[len(values) // 10 :]
    third = len(values) // 3
    return of(values[:third]), of(values[-third:])


def test_nothing_grows(tiny_run, tiny_folder, tmp_path) -> None:
    for attempt in (1, 2):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        samples = soak(tiny_run, tiny_folder, folder)
        assert len(samples) == STEPS // EVERY
        resident = thirds(median, [sample["resident"] for sample in samples])
        files = thirds(median, [sample["files"] for sample in samples])
        threads = thirds(median, [sample["threads"] for sample in samples])
        cpu = thirds(min, [sample["cpu"] for sample in samples])
        print(
            f"resident {resident}, files {files}, threads {threads}, CPU seconds of {EVERY} steps {cpu}"
        )
        assert files[0] == files[1] == samples[-1]["files"]
        assert threads[0] == threads[1]
        assert resident[1] - resident[0] < MEMORY_GROWTH
        assert len(list((folder / "run").rglob("*.safetensors"))) == 3
        if cpu[1] < TIME_GROWTH * cpu[0]:
            return
    raise AssertionError(
        f"{EVERY} steps took {cpu[0]:.3f} s of CPU time in the first third, {cpu[1]:.3f} in the last"
    )
