"""New files that replace the old ones all together."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from learn3d.terminal import stop_on_signal


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
