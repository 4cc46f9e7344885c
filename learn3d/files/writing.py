"""Files that appear under their names only when complete: an interrupted write leaves the old file as it was."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def replacing(path: Path, *, sync: bool = False) -> Iterator[Path]:
    """Gives a temporary path in the folder of `path`; what was written there takes the name `path` when the block ends.

    After an exception nothing is left of it; a killed process leaves the temporary file (`remove_partials`). With
    `sync` the content is on the disk before it takes the name, and the name before the block ends, so that not even a
    power cut leaves half a file or brings the old one back. Raises OSError where `path` is there and no plain file: a
    folder, or a device such as /dev/null, which must not be replaced.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OSError(f"{path} is no plain file and is not replaced; give another name")
    temporary = path.with_name(f".{path.name}.partial")
    temporary.unlink(missing_ok=True)  # a killed process may have left it as a second name of a file
    try:
        yield temporary
        if sync:
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if sync and os.name == "posix":  # Windows cannot open folders
            folder = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    except OSError as error:
        if error.errno is not None and error.filename is None:  # a full disk does not say which file it had no room for
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def check_target(path: Path, option: str, *, folder: bool = False) -> None:
    """Raise OSError where `path` cannot be written. For the beginning of long work; nothing is left of the attempt.

    With `folder` it is a folder for files, which need not be there yet. `option` is how the command calls the path.
    """
    path = Path(path)
    there = next(p for p in (path, *path.parents) if os.path.lexists(p)) if folder else path.parent
    try:
        if not there.is_dir():
            raise OSError(f"{there} is a file" if there.is_file() else f"there is no folder {there}")
        if not folder and path.exists() and not path.is_file():
            raise OSError("it is no plain file, and is not replaced")
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise OSError(f"cannot write {path}: {error.strerror or error}; give another {option}") from error


def remove_partials(*folders: Path) -> None:
    """Remove the temporary files that a killed process left in these folders."""
    for folder in folders:
        for path in folder.glob(".*.partial"):
            path.unlink(missing_ok=True)


def give_second_name(path: Path, name: Path) -> None:
    """Let a file be found under another name as well, by a hard link, or as a copy where the file system has none.

    A file of that name is replaced.
    """
    with replacing(name, sync=True) as temporary:
        try:
            os.link(path, temporary)
        except OSError:
            shutil.copyfile(path, temporary)


def write_bytes(path: Path, content: bytes, *, sync: bool = False) -> None:
    """Write a whole file."""
    with replacing(path, sync=sync) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, value: Any, *, sync: bool = False) -> None:
    """Write a value as indented JSON with a line break at the end."""
    write_bytes(path, (json.dumps(value, indent=2) + "\n").encode(), sync=sync)
