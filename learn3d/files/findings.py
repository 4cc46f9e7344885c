"""Faults of the files of a data set: errors that name the file, and a list of them.

A reader parses an object in steps, each through `Findings.attempt`. With strict findings the first step that fails
raises; otherwise it is noted and the next one follows. So loading a data set and checking it are the same walk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

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
