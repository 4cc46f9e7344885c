"""The folder that a data set is written to: what is there, whether there is room, and the move to the final names."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from learn3d.files.writing import check_target
from learn3d.terminal import stop_on_signal


def existing(folder: Path, paths: Iterable[str]) -> list[str]:
    """Those of the relative paths that exist in the folder."""
    return [path for path in paths if (folder / path).exists()]


def check_room(folder: Path, needed: int, what: str) -> None:
    """Make the folder; OSError where it cannot be written into or its disk has less than `needed` bytes free."""
    check_target(folder, "--output", folder=True)
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(
            f"{what} may need {needed / 2**20:.0f} MiB but the disk of {folder} has {free / 2**20:.0f} MiB free; "
            "free some, give another folder, or use fewer meshes or augmented copies"
        )


def publish(new: Path, folder: Path, paths: list[str], old: list[str], trash: Path) -> None:
    """Move the files and folders `paths` from `new` to `folder`, and those in `old` from there to `trash` before.

    All on one file system, so that nothing is copied. The caller removes `trash`. An interruption waits until all is in
    place: files of two data sets do not go together.
    """
    with stop_on_signal():
        moves = [(folder / path, trash / path) for path in old] + [(new / path, folder / path) for path in paths]
        for source, target in moves:
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, target)
