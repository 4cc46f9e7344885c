"""Versions of the code behind a result, and its git commit."""

from __future__ import annotations

import functools
import importlib.metadata
import subprocess
from pathlib import Path

import torch


@functools.cache
def versions() -> dict[str, str | None]:
    """Versions of the package and of torch, and the git commit of the code (None if unknown).

    A process asks once, before it works: a commit made afterwards is not the code that runs.
    """
    try:
        package = importlib.metadata.version("nmr-learn3d")
    except importlib.metadata.PackageNotFoundError:
        package = None
    return {"nmr-learn3d": package, "torch": torch.__version__, "commit": _git_commit()}


def _git_commit() -> str | None:
    """Commit of the checkout that holds this file (with "-dirty" after changes), or that it was installed from."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("rev-parse", "HEAD") + ("-dirty" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        built_from = Path(__file__).parents[1] / "commit.txt"  # CMakeLists.txt writes it
        return (built_from.read_text().strip() if built_from.exists() else "") or None
