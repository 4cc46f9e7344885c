"""Reading what somebody else may have made: sizes before contents, JSON that is only JSON.

Every refusal is a `DamagedFile` (a ValueError) or `MissingFile` (a FileNotFoundError) that names the file.
"""

from __future__ import annotations

import json
import math
import os
import stat
from pathlib import Path
from typing import Any

from learn3d.files.findings import FETCH_AGAIN, DamagedFile, MissingFile


def check_file(path: Path | str, most: int, wanted: str) -> int:
    """The size of a plain file in bytes; refused where it is none (a pipe would be waited for) or has over `most`."""
    try:
        status = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        raise MissingFile(Path(path), f"is missing; expected {wanted}") from None
    except (OSError, ValueError) as error:
        raise DamagedFile(Path(path), f"cannot be read ({error}); expected {wanted}") from error
    if not stat.S_ISREG(status.st_mode):
        raise DamagedFile(Path(path), f"cannot be read: it is no plain file; expected {wanted}")
    if status.st_size > most:
        raise DamagedFile(
            Path(path), f"has {status.st_size} bytes, and at most {most} are read; expected {wanted}. Is it that file?"
        )
    return status.st_size


def read_bytes(path: Path | str, most: int, wanted: str) -> bytes:
    """A whole file of at most `most` bytes, also where another has taken its place since it was looked at."""
    check_file(path, most, wanted)
    try:
        with open(path, "rb", opener=_open_at_once) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise OSError("it is no plain file any more")
            return file.read(min(status.st_size, most))
    except OSError as error:
        raise DamagedFile(Path(path), f"cannot be read ({error}); expected {wanted}. {FETCH_AGAIN}") from error


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def read_text(path: Path | str, most: int, wanted: str, *, encoding: str = "utf-8", errors: str = "strict") -> str:
    """A whole text file of at most `most` bytes, its line ends as \\n."""
    try:
        text = read_bytes(path, most, wanted).decode(encoding, errors)
    except UnicodeDecodeError as error:
        raise DamagedFile(Path(path), f"cannot be read as text ({error}); expected {wanted}. {FETCH_AGAIN}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str | bytes, *, finite: bool = True) -> Any:
    """The value of a JSON text; a ValueError says what is wrong with it, the caller where it is.

    finite: refuse NaN and Infinity, which JSON does not have, and numbers that a float cannot hold. Whole numbers have
    at most 300 digits in any case.
    """
    try:
        text = text.decode("utf-8") if isinstance(text, bytes) else text
        kinds = {"parse_constant": _refuse, "parse_float": _finite} if finite else {}
        return json.loads(text, parse_int=_whole, **kinds)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _refuse(word: str) -> Any:
    raise ValueError(f"{word} is no number of JSON")


def _whole(digits: str) -> int:
    if len(digits) > 300:  # beyond 308 digits no float holds it
        raise ValueError(f"a whole number has {len(digits)} digits")
    return int(digits)


def _finite(word: str) -> float:
    if not math.isfinite(value := float(word)):
        raise ValueError(f"{word[:30]} is too large a number")
    return value
