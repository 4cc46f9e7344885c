"""Opens and reads untrusted files, and collects their faults.

A fault is a `DamagedFile` (a ValueError) or `MissingFile` (a FileNotFoundError), whose message names the file.
"""

import json
import os
import stat
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeVar

R = TypeVar("R")

FETCH_AGAIN = "Perhaps the download or copy was cut short: fetch it again"


class _FileError(Exception):
    def __init__(self, path: Path, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path, self.message = path, message

    def __reduce__(self) -> tuple[type, tuple[Path, str]]:
        return type(self), (self.path, self.message)  # for pickle, which passes only the text by default


class DamagedFile(_FileError, ValueError):
    """A file or folder with wrong content."""


class MissingFile(_FileError, FileNotFoundError):
    """A missing file or folder."""


@dataclass(frozen=True)
class Problem:
    """One fault of a file. `load` raises errors and ignores warnings."""

    path: str
    message: str  # the fault, and what was expected
    severity: Literal["error", "warning"] = "error"


@dataclass
class Findings:
    """Collects the faults of a data set. With strict findings the first fault is raised; so the same code loads and
    checks a data set.
    """

    strict: bool = False  # True: raise the first error, ignore warnings
    problems: list[Problem] = field(default_factory=list)
    objects: int = 0  # number of objects that the files list

    def attempt(self, function: Callable[..., R], *arguments: Any) -> R | None:
        """The result of function(*arguments). If it raises a fault, the fault is recorded, and the result is None."""
        try:
            return function(*arguments)
        except (DamagedFile, MissingFile) as error:
            return self.take(error)

    def take(self, result: Any) -> Any:
        """A result of `sandbox.read_all`. If it is a fault, the fault is recorded, and the result is None."""
        if not isinstance(result, (DamagedFile, MissingFile)):
            return result
        if self.strict:
            raise result
        self.problems.append(Problem(str(result.path), result.message))
        return None

    def warn(self, path: Path, message: str) -> None:
        """Record a warning."""
        if not self.strict:
            self.problems.append(Problem(str(path), message, "warning"))


STRICT = Findings(strict=True)


def open_file(path: Path | str, max_bytes: int, wanted: str) -> BinaryIO:
    """Open an untrusted file for reading. wanted: description of the file, for messages.

    Raises MissingFile, and DamagedFile for files above `max_bytes` bytes and, at once, for pipes and devices.
    """
    path = Path(path)
    try:
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
    except (FileNotFoundError, NotADirectoryError):
        raise MissingFile(path, f"is missing; expected {wanted}") from None
    except (OSError, ValueError) as error:
        raise DamagedFile(path, f"cannot be read ({error}); expected {wanted}") from error
    status = os.fstat(file.fileno())
    fault = f"has {status.st_size} bytes; the limit is {max_bytes}" if status.st_size > max_bytes else ""
    if not stat.S_ISREG(status.st_mode):
        fault = "cannot be read: it is not a regular file"
    if fault:
        file.close()
        raise DamagedFile(path, f"{fault}; expected {wanted}")
    return file


def read_bytes(path: Path | str, max_bytes: int, wanted: str) -> bytes:
    """The content of a file. Raises as `open_file`."""
    with open_file(path, max_bytes, wanted) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def read_text(path: Path | str, max_bytes: int, wanted: str, *, encoding: str = "utf-8", errors: str = "strict") -> str:
    """The content of a text file, with line ends \\n. Raises as `open_file`, and DamagedFile for another encoding."""
    try:
        text = read_bytes(path, max_bytes, wanted).decode(encoding, errors)
    except UnicodeDecodeError as error:
        raise DamagedFile(Path(path), f"cannot be read as text ({error}); expected {wanted}. {FETCH_AGAIN}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path | str, max_bytes: int, wanted: str) -> Any:
    """The value of a JSON file. Raises as `open_file`, and DamagedFile for other content."""
    content = read_bytes(path, max_bytes, wanted)
    try:
        return parse_json(content)
    except ValueError as error:
        raise DamagedFile(Path(path), f"is not valid JSON ({error}); expected {wanted}. {FETCH_AGAIN}") from error


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text. Raises ValueError if it is invalid."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
