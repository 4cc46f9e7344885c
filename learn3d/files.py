"""Files that appear under their names only when complete: an interrupted write leaves the old file as it was."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replacing(path: Path, *, sync: bool = False) -> Iterator[Path]:
    """Gives a temporary path in the folder of `path`; what was written there takes the name `path` when the block ends.

    After an exception nothing is left of it. With `sync` the content is on the disk before it takes the name, so that
    not even a power cut leaves half a file. Raises OSError where `path` is there and no plain file: a folder, or a
    device such as /dev/null, which must not be replaced.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OSError(f"{path} is no plain file and is not replaced; give another name")
    temporary = path.with_name(f".{path.name}.partial")
    try:
        yield temporary
        if sync:
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON with a line break at the end."""
    write_bytes(path, (json.dumps(value, indent=2) + "\n").encode())
