"""The commands at the top of docs/scale.md run as they are written; the syntax of the examples for clusters."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs bash")
def test_the_commands_of_the_page(tmp_path) -> None:
    commands = re.search(r"```sh\n(.*?)```", (DOCS / "scale.md").read_text(), re.DOTALL)[1]
    assert [line.split()[0] for line in commands.splitlines()] == [
        "dask",
        "dask",
        "learn3d",
        "torchrun",
        "learn3d",
    ]
    folders = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    if not shutil.which("dask", path=folders):
        pytest.skip("needs the extra cluster")
    shutil.copytree(ROOT / "tools", tmp_path / "tools")
    script = f"set -e\ntrap 'kill $(jobs -p)' EXIT\n{commands}"
    environment = os.environ | {"PATH": folders, "OMP_NUM_THREADS": "1"}
    call = {
        "cwd": tmp_path,
        "env": environment,
        "capture_output": True,
        "text": True,
        "timeout": 900,
    }
    ended = subprocess.run(["bash", "-c", script], **call)
    assert ended.returncode == 0, ended.stderr
    assert {"big/03001627/train/set.json", "runs/chair/last.safetensors", "tables/kato.md"} <= {
        str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")
    }
    assert (
        "in each of 2 ranks (gloo)" in ended.stderr
        and "[3/3] " in ended.stderr
        and "[2/2] " in ended.stderr
    )


def test_the_syntax_of_the_examples() -> None:
    subprocess.run(["bash", "-n", DOCS / "cluster" / "slurm.sh"], check=True)
    parts = list(yaml.safe_load_all((DOCS / "cluster" / "kubernetes.yaml").read_text()))
    assert [part["kind"] for part in parts] == ["Service", "Deployment", "Deployment", "Job"]
    for part in parts[1:]:
        container = part["spec"]["template"]["spec"]["containers"][0]
        assert container["image"] == "IMAGE" and container["command"][0] in ("dask", "learn3d")
