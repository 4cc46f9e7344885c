"""Writes files and folders atomically: they appear complete or not at all."""

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
def _naming(path: Path) -> Iterator[None]:
    """Give an OSError without a file name this one: that for a full disk has none."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def replacing(path: Path, *, sync: bool = False, writer: str = "") -> Iterator[Path]:
    """Yield a temporary path in the folder of `path`; at the end the file there is renamed to
    `path`.

    After an exception the temporary file is removed; a killed process leaves it. sync: the file
    is complete even after a power failure. writer: part of the temporary name, if several
    processes may write the same file. Raises OSError if `path` is a folder, a pipe or a device.
    """
    path = Path(path)
    _require_regular(path)
    temporary = path.with_name(f".{path.name}{writer}.partial")
    # a killed process may have left a hard link, which must not be overwritten
    temporary.unlink(missing_ok=True)
    try:
        with _naming(path):
            temporary.touch()
            # as the umask says; safetensors would let only the owner read its files
            mode = temporary.stat().st_mode
            temporary.unlink()
            yield temporary
            temporary.chmod(mode)
            if sync:
                _sync(temporary)
            os.replace(temporary, path)
            if sync:
                _sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _require_regular(path: Path) -> None:
    # /dev/stdout is a link into /proc; it must stay one even if the output is redirected to a regular file.
    into_proc = path.is_symlink() and path.readlink().is_relative_to("/proc")
    if into_proc or (path.exists() and not path.is_file()):
        raise OSError(f"{path} is not a regular file and is not replaced")


def _sync(path: Path) -> None:
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def check_target(path: Path, option: str, *, folder: bool = False) -> None:
    """Raise OSError if `path` cannot be written.

    To be called before long computations; it leaves no files.

    folder: `path` is a folder, which need not exist. option: the command's option for the path,
    for the message.
    """
    path = Path(path)
    existing = next(p for p in (path, *path.parents) if p.exists()) if folder else path.parent
    try:
        if not folder:
            _require_regular(path)
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise OSError(
            f"cannot write {path}: {error.strerror or error}; give another {option}"
        ) from error


def give_second_name(path: Path, name: Path) -> None:
    """Make `name` a hard link to `path`, or a copy if the file system has no hard links.

    Replaces a file `name`.
    """
    with replacing(name, sync=True) as temporary:
        try:
            os.link(path, temporary)
        except OSError:
            shutil.copyfile(path, temporary)


def write_bytes(path: Path, content: bytes, *, sync: bool = False) -> None:
    """Write a file atomically, see `replacing`."""
    with replacing(path, sync=sync) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, value: Any, *, sync: bool = False) -> None:
    """Write a value as indented JSON atomically, see `replacing`."""
    write_bytes(path, (json.dumps(value, indent=2) + "\n").encode(), sync=sync)


@contextlib.contextmanager
def publishing(folder: Path, paths: Sequence[str]) -> Iterator[Path]:
    """Yield a temporary folder in `folder`; at the end its files and folders `paths` replace
    those of `folder`.

    If one of `paths` is missing in it, it is removed from `folder`; all other files stay. After
    an exception nothing changes. Signals wait until all files are moved, so that files of two
    data sets are never mixed.
    """
    with tempfile.TemporaryDirectory(prefix=".make_dataset_", dir=folder) as temporary:
        new, old = Path(temporary) / "new", Path(temporary) / "old"
        new.mkdir()
        with _naming(folder):
            yield new
        with stop_on_signal():
            for source, target in ((folder, old), (new, folder)):
                for path in paths:
                    if (source / path).exists():
                        (target / path).parent.mkdir(parents=True, exist_ok=True)
                        os.replace(source / path, target / path)
