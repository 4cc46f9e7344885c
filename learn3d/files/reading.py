"""Opens and reads untrusted files, and reports their faults.

A fault is a `DamagedFile` (a ValueError) or `MissingFile` (a FileNotFoundError), whose message
names the file. A reader gives every fault of a data set to a `FaultHandler`: in a training that is
`refuse`, which raises it; `learn3d check-dataset` collects them.
"""

import contextlib
import json
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias, TypeVar

R = TypeVar("R")

FETCH_AGAIN = "Perhaps the download or copy was cut short: fetch it again"


class _FileError(Exception):
    def __init__(self, path: Path, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path, self.message = path, message

    def __reduce__(self) -> tuple[type, tuple[Path, str]]:
        return type(self), (self.path, self.message)  # pickle would pass only the text


class DamagedFile(_FileError, ValueError):
    """A file or folder with wrong content."""


class MissingFile(_FileError, FileNotFoundError):
    """A missing file or folder."""


FAULTS = (DamagedFile, MissingFile)


class OddFile(_FileError, UserWarning):
    """A file or folder that can be read, but is probably not as it was meant."""


#: Where a reader says what it finds. It raises, or the reader goes on without the faulty file.
FaultHandler: TypeAlias = Callable[[_FileError], None]


def refuse(found: _FileError) -> None:
    """What readers that need every file do: raise a fault, and ignore what is odd."""
    if not isinstance(found, OddFile):
        raise found


def attempt(on_fault: FaultHandler, function: Callable[..., R], *arguments: Any) -> R | None:
    """The result of function(*arguments).

    If it raises a fault, the fault is reported, and the result is None.
    """
    try:
        return function(*arguments)
    except FAULTS as fault:
        on_fault(fault)


@contextlib.contextmanager
def faults_of(path: Path | str, wanted: str, advice: str = FETCH_AGAIN) -> Iterator[None]:
    """Turn errors into a DamagedFile or MissingFile: libraries raise various ones for damaged
    files.

    wanted: description of the file, for messages. advice: what to do; after an EOFError always to
    fetch it again.
    """
    try:
        yield
    except FAULTS:
        raise
    except (FileNotFoundError, NotADirectoryError):
        raise MissingFile(Path(path), f"is missing; expected {wanted}") from None
    except Exception as error:
        reason = (str(error).strip().splitlines() or [""])[0][:300]
        if isinstance(error, MemoryError):
            reason = "it takes too much memory"
        elif isinstance(error, OSError) and error.strerror:
            reason = error.strerror.lower()
        elif type(error) not in (ValueError, EOFError):
            reason = f"{type(error).__name__}: {reason}".removesuffix(": ")
        advice = FETCH_AGAIN if isinstance(error, EOFError) else advice
        # errno: the system names the cause
        end = "" if getattr(error, "errno", None) or not advice else f". {advice}"
        raise DamagedFile(
            Path(path), f"cannot be read ({reason}); expected {wanted}{end}"
        ) from error


def open_file(path: Path | str, max_bytes: int, wanted: str) -> BinaryIO:
    """Open an untrusted file for reading. wanted: description of the file, for messages.

    Raises MissingFile, and DamagedFile for files above `max_bytes` bytes and, at once, for pipes
    and devices.
    """
    path = Path(path)
    with faults_of(path, wanted):
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
    status = os.fstat(file.fileno())
    fault = (
        f"has {status.st_size} bytes; the limit is {max_bytes}"
        if status.st_size > max_bytes
        else ""
    )
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


def read_text(path: Path | str, max_bytes: int, wanted: str, *, encoding: str = "utf-8") -> str:
    """The content of a text file, with line ends \\n.

    Raises as `open_file`, and DamagedFile for another encoding.
    """
    with faults_of(path, wanted):
        text = read_bytes(path, max_bytes, wanted).decode(encoding)
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path | str, max_bytes: int, wanted: str) -> Any:
    """The value of a JSON file. Raises as `open_file`, and DamagedFile for other content."""
    with faults_of(path, wanted):
        return parse_json(read_bytes(path, max_bytes, wanted))


def parse_json(text: str | bytes) -> Any:
    """The value of a JSON text. Raises ValueError if it is invalid."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
