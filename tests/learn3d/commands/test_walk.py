"""From meshes to figures by the commands alone, each to its end, with tiny networks."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from learn3d.files.formats import read_mesh

ROOT = Path(__file__).parents[3]
SMALL = "--encoder conv-small --generator sphere-small --batch-size 4 --threads 1 --log-every 1"


@pytest.fixture
def walk(command):
    """Calls `learn3d` with the words of a line and paths; asserts that it succeeds, and returns its output."""

    def call(line: str, *words: object) -> str:
        status, out, err = command(*line.split(), *words)
        assert status == 0, err
        return out

    return call


def test_every_command_of_the_way_from_meshes_to_figures(walk, tiny_names, tmp_path: Path) -> None:
    data, run, model = (tmp_path / name for name in ("data", "run", "model.safetensors"))
    what = ("--category", "airplane", "--output")
    walk("make-dataset --procedural 6 --test 2 --val 1", *what, data)
    assert "0 errors" in walk("check-dataset", data)
    options = f"train --preset proposed {SMALL} --max-val-images 4 --iterations"
    walk(f"{options} 2", "--data", data, *what, run)
    said = walk("train --resume --iterations 4", "--output", run)
    assert said.startswith("finished at step 4")
    walk("evaluate", run, "--json", tmp_path / "table.json")
    (result,) = json.loads((tmp_path / "table.json").read_text())["results"]
    assert result["images"] == 48 and 0 < result["voxel_iou"] < 1

    walk("export --run", run, "--output", model)
    assert model.stat().st_size < (run / "last.safetensors").stat().st_size
    picture = np.zeros((60, 90, 4), np.uint8)
    picture[20:40, 10:80] = 200, 60, 40, 255
    Image.fromarray(picture).save(tmp_path / "plane.png")
    for number, line in enumerate(("plane.png --format obj", "--indices 0 30 --data DATA")):
        words = [
            {"DATA": data, "plane.png": tmp_path / "plane.png"}.get(w, w) for w in line.split()
        ]
        walk("reconstruct --run", model, "--output", tmp_path / f"{number}", *words)
        meshes = [p for p in (tmp_path / f"{number}").iterdir() if p.suffix in (".obj", ".glb")]
        assert len(meshes) == 1 + number
        assert all(len(read_mesh(mesh).faces) > 500 for mesh in meshes)

    pytest.importorskip("plotly")
    walk("report --objects 2", run, "--output", tmp_path / "report.html")
    assert "Proposed" in (tmp_path / "report.html").read_text()
    pytest.importorskip("matplotlib")
    for figure in ("grid --images 2", "tsne", "interpolation --indices 0 30"):
        words = ("--runs", run, "--output", tmp_path / f"{figure.split()[0]}.png")
        for path in walk(f"figures {figure}", *words).split():
            assert Path(path).stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a script of bash")
def test_the_quick_start_ends(tmp_path: Path) -> None:
    """All steps of the script but the installation, with few objects and steps."""
    (tmp_path / "tools").mkdir()
    (tmp_path / ".venv/bin").mkdir(parents=True)
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    (tmp_path / "tools/quickstart.sh").write_text((ROOT / "tools/quickstart.sh").read_text())
    (tmp_path / "tools/setup.sh").write_text('step() { echo "== $1"; }\nsetup() { :; }\n')
    for name, command in {"python": "", "learn3d": "-m learn3d"}.items():
        program = tmp_path / ".venv/bin" / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" {command} "$@"\n')
        program.chmod(0o755)
    settings = {"STEPS": "16", "OBJECTS": "24", "OUT": str(tmp_path / "out")}
    ended = subprocess.run(
        ["bash", tmp_path / "tools/quickstart.sh"],
        capture_output=True, text=True, env=os.environ | settings, timeout=3000,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout[-3000:] + ended.stderr[-3000:]
    made = tmp_path / "out"
    results = json.loads((made / "evaluation.json").read_text())["results"]
    assert [result["iterations"] for result in results] == [16, 4]
    assert len(list((made / "meshes").glob("*.glb"))) == 4
    assert (made / "report.html").is_file() and (made / "pictures/small-model.png").is_file()
