"""The real command `learn3d demo` with two runs, and the address of its page."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module")
def server(finished_run, tmp_path_factory) -> Iterator[tuple[subprocess.Popen, str]]:
    pytest.importorskip("uvicorn", reason="needs the extra demo")
    folder = tmp_path_factory.mktemp("demo")
    shutil.copytree(finished_run, folder / "other")
    words = [
        sys.executable,
        "-m",
        "learn3d",
        "demo",
        "--port",
        "0",
        "--no-browser",
        "--run",
        str(finished_run),
    ]
    pipes = {"stdout": subprocess.PIPE, "stderr": (folder / "errors.txt").open("w"), "text": True}
    with subprocess.Popen([*words, str(folder / "other")], cwd=folder, **pipes) as process:
        process.folder = folder
        line = process.stdout.readline()
        assert "the page is at" in line, (folder / "errors.txt").read_text()
        yield process, line.split()[4]
        process.kill()
