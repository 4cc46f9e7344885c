"""The folder of a data set: is there room, and new files that replace the old ones all together."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from learn3d.files.writing import check_target
from learn3d.terminal import stop_on_signal


def check_room(folder: Path, needed: int, what: str) -> None:
    """Make the folder; raise OSError if it is not writable or its disk has less than `needed` bytes free."""
    check_target(folder, "--output", folder=True)
    folder.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(
            f"{what} may need {needed / 2**20:.0f} MiB but the disk of {folder} has {free / 2**20:.0f} MiB free; "
            "free some, give another folder, or use fewer meshes or augmented copies"
        )


@contextlib.contextmanager
def publishing(folder: Path, paths: Sequence[str]) -> Iterator[Path]:
    """Give a temporary folder in `folder`; its files and folders `paths` replace those of `folder` in the end.

    What is missing there is removed here; all other files stay. After an exception nothing changes. It is all on one
    file system, so nothing is copied, and an interruption waits until all is in place: files of two data sets do not go
    together.
    """
    with tempfile.TemporaryDirectory(prefix=".make_dataset_", dir=folder) as temporary:
        new, old = Path(temporary) / "new", Path(temporary) / "old"
        new.mkdir()
        yield new
        with stop_on_signal():
            for source, target in ((folder, old), (new, folder)):
                for path in paths:
                    if (source / path).exists():
                        (target / path).parent.mkdir(parents=True, exist_ok=True)
                        os.replace(source / path, target / path)
