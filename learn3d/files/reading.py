"""Opening and reading untrusted files: kind and size before content, JSON that is only JSON.

Every refusal is a `DamagedFile` (a ValueError) or `MissingFile` (a FileNotFoundError) that names the file.
"""

from __future__ import annotations

import json
import math
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

from learn3d.files.findings import FETCH_AGAIN, DamagedFile, MissingFile


def open_file(path: Path | str, most: int, wanted: str) -> BinaryIO:
    """A plain file of at most `most` bytes, opened. A pipe is not waited for, and a device not read.

    Every untrusted file is opened here. wanted: description of the file, for messages. Raises MissingFile, DamagedFile.
    """
    path = Path(path)
    try:
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
    except (FileNotFoundError, NotADirectoryError):
        raise MissingFile(path, f"is missing; expected {wanted}") from None
    except (OSError, ValueError) as error:
        raise DamagedFile(path, f"cannot be read ({error}); expected {wanted}") from error
    status = os.fstat(file.fileno())
    if stat.S_ISREG(status.st_mode) and status.st_size <= most:
        return file
    file.close()
    fault = f"has {status.st_size} bytes, and at most {most} are read"
    if not stat.S_ISREG(status.st_mode):
        fault = "cannot be read: it is no plain file"
    raise DamagedFile(path, f"{fault}; expected {wanted}")


def check_file(path: Path | str, most: int, wanted: str) -> int:
    """The size in bytes of a file that `open_file` opens."""
    with open_file(path, most, wanted) as file:
        return os.fstat(file.fileno()).st_size


def read_bytes(path: Path | str, most: int, wanted: str) -> bytes:
    """A whole file of at most `most` bytes."""
    with open_file(path, most, wanted) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path | str, most: int, wanted: str, *, encoding: str = "utf-8", errors: str = "strict") -> str:
    """A whole text file of at most `most` bytes, its line ends as \\n."""
    try:
        text = read_bytes(path, most, wanted).decode(encoding, errors)
    except UnicodeDecodeError as error:
        raise DamagedFile(Path(path), f"cannot be read as text ({error}); expected {wanted}. {FETCH_AGAIN}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str | bytes, *, finite: bool = True) -> Any:
    """The value of a JSON text. Raises ValueError, also for NaN and infinities unless `finite` is False."""

    def number(word: str) -> float:
        if not math.isfinite(value := float(word)):
            raise ValueError(f"{word[:30]} is no number of JSON that a float holds")
        return value

    try:
        kinds = {"parse_constant": number, "parse_float": number} if finite else {}
        return json.loads(text, **kinds)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
