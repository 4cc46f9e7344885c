"""The kernels alone: their C++ tests, plain and under sanitizers, the fuzz corpus, and the instruction count of W1."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(sys.platform != "linux", reason="tools/check_native.sh is for Linux")
@pytest.mark.parametrize(
    "check",
    ["tests", "count", *(pytest.param(name, marks=pytest.mark.slow) for name in ("asan", "tsan"))],
)
def test_native(check):
    result = subprocess.run(
        ["bash", "tools/check_native.sh", check],
        cwd=ROOT,
        env={**os.environ, "PYTHON": sys.executable},
        capture_output=True,
        text=True,
    )
    if result.returncode == 77:
        pytest.skip(result.stdout.strip().splitlines()[-1])
    print(result.stdout)
    assert result.returncode == 0, f"{result.stdout[-6000:]}\n{result.stderr[-6000:]}"
