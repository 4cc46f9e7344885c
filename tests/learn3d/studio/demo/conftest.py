"""The real command `learn3d demo`, with two runs, one, or the package's model, and the address of its page."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest


class Sent(NamedTuple):
    """A picture as the page sends it: a blue box on grey; its mask is unknown."""

    size: int  # pixels of each side
    address: str  # with its query
    content: bytes  # R, G, B, mask


@pytest.fixture(scope="session")
def box() -> Sent:
    pixels = np.full((64, 64, 4), 255, np.uint8)
    pixels[..., :3] = 200
    pixels[16:48, 16:48, :3] = (40, 60, 120)
    return Sent(64, "mesh?width=64&height=64", pixels.tobytes())


class Server(NamedTuple):
    """A running `learn3d demo`."""

    process: subprocess.Popen
    address: str
    errors: Path  # what it wrote to stderr


@contextlib.contextmanager
def serving(folder: Path, *words: object) -> Iterator[Server]:
    pytest.importorskip("uvicorn", reason="needs the extra demo")
    command = [sys.executable, "-m", "learn3d", "demo", "--port", 0, "--no-browser", *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": (folder / "errors.txt").open("w"), "text": True}
    with subprocess.Popen(list(map(str, command)), cwd=folder, **pipes) as process:
        line = process.stdout.readline()
        assert "the page is at" in line, (folder / "errors.txt").read_text()
        try:
            yield Server(process, line.split()[4], folder / "errors.txt")
        finally:
            process.kill()


@pytest.fixture(scope="module")
def server(finished_run, tmp_path_factory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("demo")
    shutil.copytree(finished_run, folder / "other")
    with serving(folder, "--run", finished_run, folder / "other") as server:
        yield server


@pytest.fixture(scope="module")
def single(finished_run, tmp_path_factory) -> Iterator[Server]:
    """With one run: it answers in half the time."""
    with serving(tmp_path_factory.mktemp("single"), "--run", finished_run) as server:
        yield server


@pytest.fixture(scope="module")
def packaged(tmp_path_factory) -> Iterator[Server]:
    """With the model that every visitor gets."""
    with serving(tmp_path_factory.mktemp("packaged")) as server:
        yield server
