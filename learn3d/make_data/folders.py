"""The folder that a data set is written into: what is there, is there room, and the move to the final names."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from learn3d.files.writing import check_target_folder
from learn3d.interrupt import stop_on_signal


def existing(folder: Path, paths: Iterable[str]) -> list[str]:
    """Those of the relative paths that exist in the folder."""
    return [path for path in paths if (folder / path).exists()]


def check_room(folder: Path, needed: int, what: str) -> None:
    """Make the folder; OSError where it cannot be written into or its disk has less than `needed` bytes free."""
    check_target_folder(folder, "--output")
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(
            f"{what} may need {needed / 2**20:.0f} MiB but the disk of {folder} has {free / 2**20:.0f} MiB free; "
            "free some, give another folder, or use fewer meshes or augmented copies"
        )


def publish(new: Path, folder: Path, paths: list[str], stale: list[str], trash: Path) -> None:
    """Move files and folders from `new` to `folder`, where they replace what has their names, and take `stale` away.

    All three on one file system. What is replaced or stale goes to `trash`, which the caller removes: a folder of many
    files is there or not, never half. An interruption waits until all is in place: files of two data sets do not go
    together.
    """
    with stop_on_signal():
        for path in stale:
            _move(folder / path, trash / "stale" / path)
        for path in paths:
            if (folder / path).is_dir():
                _move(folder / path, trash / "replaced" / path)
            _move(new / path, folder / path)


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(source, target)
