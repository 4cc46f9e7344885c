"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from learn3d.terminal import stop_on_signal


@contextlib.contextmanager
def replacing(path: Path, *, sync: bool = False) -> Iterator[Path]:
    """Gives a temporary path in the folder of `path`; the file written there takes the name `path` at the end.

    After an exception nothing is left of it; a killed process leaves the temporary file (`remove_partials`). With
    `sync` not even a power cut leaves half a file. Raises OSError if `path` is a folder, a pipe or a device.
    """
    path = Path(path)
    if not _may_replace(path):
        raise OSError(f"{path} is no plain file and is not replaced; give another name")
    temporary = path.with_name(f".{path.name}.partial")
    temporary.unlink(missing_ok=True)  # a killed process may have left it as a second name of a file
    try:
        yield temporary
        if sync:
            _sync(temporary)
        os.replace(temporary, path)
        if sync:
            _sync(path.parent)
    except OSError as error:
        if error.errno is not None and error.filename is None:  # a full disk does not name the file
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def _may_replace(path: Path) -> bool:
    # /dev/stdout is a link into /proc; it must stay one even if the output goes to a plain file.
    into_proc = path.is_symlink() and path.readlink().is_relative_to("/proc")
    return not into_proc and (path.is_file() or not path.exists())


def _sync(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def check_target(path: Path, option: str, *, folder: bool = False) -> None:
    """Raise OSError if `path` cannot be written. For the beginning of long work; nothing is left of the attempt.

    With `folder` it is a folder for files, which need not be there yet. `option` is the command's name of the path.
    """
    path = Path(path)
    there = next(p for p in (path, *path.parents) if p.exists()) if folder else path.parent
    try:
        if not folder and not _may_replace(path):
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
    """Let a file be found under another name as well, in place of a file of that name.

    It is a hard link, or a copy if the file system has none.
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
