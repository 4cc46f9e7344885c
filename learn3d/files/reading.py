"""Opening and reading untrusted files, and the faults that are found in them.

Every refusal is a `DamagedFile` (a ValueError) or `MissingFile` (a FileNotFoundError) that names the file.

A reader parses an object in steps, each through `Findings.attempt`. With strict findings the first step that fails
raises; otherwise it is noted and the next one follows. So loading a data set and checking it are the same walk.
"""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeVar

R = TypeVar("R")

FETCH_AGAIN = "Perhaps the download or copy was cut short: fetch it again"


class _NamesFile(Exception):
    def __init__(self, path: Path, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path, self.message = path, message

    def __reduce__(self) -> tuple[type, tuple[Path, str]]:
        return type(self), (self.path, self.message)  # so that it can be pickled


class DamagedFile(_NamesFile, ValueError):
    """A file that is there, but not as it should be."""


class MissingFile(_NamesFile, FileNotFoundError):
    """A file or folder that should be there."""


@dataclass(frozen=True)
class Problem:
    """One fault of a file: an error stops `load`, a warning does not."""

    path: str
    message: str  # the fault, and what was expected
    severity: Literal["error", "warning"] = "error"


@dataclass
class Findings:
    """Faults that were found while something was read."""

    strict: bool = False  # raise the first error, drop warnings
    problems: list[Problem] = field(default_factory=list)
    objects: int = 0  # number of objects that the files list

    def attempt(self, function: Callable[..., R], *arguments: Any) -> R | None:
        """The result of function(*arguments), or None with a note of why there is none."""
        try:
            return function(*arguments)
        except (DamagedFile, MissingFile) as error:
            return self.take(error)

    def take(self, result: Any) -> Any:
        """A result of `sandbox.read_all`; None with a note if it is a fault of its file."""
        if not isinstance(result, (DamagedFile, MissingFile)):
            return result
        if self.strict:
            raise result
        self.problems.append(Problem(str(result.path), result.message))
        return None

    def warn(self, path: Path, message: str) -> None:
        """Note something that is odd, but can be read."""
        if not self.strict:
            self.problems.append(Problem(str(path), message, "warning"))


STRICT = Findings(strict=True)


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
