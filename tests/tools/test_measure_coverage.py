"""What recipes of generated shapes are worth."""

from pathlib import Path

import measure_coverage
import numpy as np
import pytest

from learn3d.studio.shapes import numbered_shape


def test_coverage_of_a_template_is_whole(capsys: pytest.CaptureFixture, tmp_path: Path) -> None:
    shape = numbered_shape("lamp", 0, 2)
    np.savez(tmp_path / "pack.npz", v0=shape.vertices, f0=shape.faces)
    measure_coverage.main("lamp", tmp_path / "pack.npz", count=4)
    first, _, *rows = capsys.readouterr().out.splitlines()
    assert first.endswith("IoU 1.000")
    assert sum(int(row.split()[-4]) for row in rows) == 4
    assert [float(row.split()[-2]) > 0 for row in rows].count(True) == 1
