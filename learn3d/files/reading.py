"""Reading what somebody else may have made: sizes before contents, JSON that is only JSON, a limit of time and memory.

Every refusal is a `DamagedFile` (a ValueError) or `MissingFile` (a FileNotFoundError) that names the file.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import stat
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from learn3d.files import limits
from learn3d.files.findings import AGAIN, DamagedFile, MissingFile

_ESCAPE, _STRING = re.compile(r"\\.", re.DOTALL), re.compile(r'"[^"]*"?')


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
        raise DamagedFile(Path(path), f"cannot be read ({error}); expected {wanted}. {AGAIN}") from error


def _open_at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def read_text(path: Path | str, most: int, wanted: str, *, encoding: str = "utf-8", errors: str = "strict") -> str:
    """A whole text file of at most `most` bytes, its line ends as \\n."""
    try:
        text = read_bytes(path, most, wanted).decode(encoding, errors)
    except UnicodeDecodeError as error:
        raise DamagedFile(Path(path), f"cannot be read as text ({error}); expected {wanted}. {AGAIN}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str | bytes, *, finite: bool = True) -> Any:
    """The value of a JSON text nested at most 32 deep; a ValueError says what is wrong with it, the caller where it is.

    finite: refuse NaN and Infinity, which JSON does not have, and numbers that a float cannot hold. Whole numbers have
    at most 300 digits in any case.
    """
    text = text.decode("utf-8") if isinstance(text, bytes) else text
    _check_depth(text)
    return json.loads(text, parse_constant=_refuse if finite else None, parse_int=_whole, parse_float=_float(finite))


def _check_depth(text: str) -> None:
    depth = 0
    for bracket in re.finditer(r"[\[\]{}]", _STRING.sub("", _ESCAPE.sub("", text))):
        depth += 1 if bracket[0] in "[{" else -1
        if depth > limits.JSON_DEPTH:
            raise ValueError(f"it is nested more than {limits.JSON_DEPTH} levels deep")


def _refuse(word: str) -> Any:
    raise ValueError(f"{word} is no number of JSON")


def _whole(digits: str) -> int:
    if len(digits) > 300:  # beyond 308 digits no float holds it, beyond 4300 Python refuses
        raise ValueError(f"a whole number has {len(digits)} digits")
    return int(digits)


def _float(finite: bool) -> Any:
    def parse(word: str) -> float:
        value = float(word)
        if finite and not math.isfinite(value):
            raise ValueError(f"{word[:30]} is too large a number")
        return value

    return parse


class _OutOfTime(BaseException):
    """No Exception: parsers catch those and go on."""


@contextlib.contextmanager
def within(seconds: float, memory: int) -> Iterator[None]:
    """Stop the block with a ValueError where it takes longer, or asks for more than `memory` bytes on top of what is.

    For parsers of others, which can be led astray. The time is limited in the main thread of POSIX systems, between two
    instructions of Python; the memory on Linux. Elsewhere the block runs unlimited.
    """
    with contextlib.ExitStack() as stack:
        try:
            _limit_memory(memory, stack)
            _limit_time(seconds, stack)
            yield
        except _OutOfTime:
            stack.close()
            raise ValueError(f"reading it was stopped after {seconds:g} seconds") from None
        except MemoryError:
            stack.close()
            raise ValueError(f"reading it takes more memory than {memory / limits.GIB:.3g} GiB") from None


def _limit_time(seconds: float, stack: contextlib.ExitStack) -> None:
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        return

    def stop(number: int, frame: object) -> None:
        raise _OutOfTime

    stack.callback(signal.signal, signal.SIGALRM, signal.signal(signal.SIGALRM, stop))
    # Once more every second: some parsers swallow whatever is raised.
    stack.callback(signal.setitimer, signal.ITIMER_REAL, *signal.setitimer(signal.ITIMER_REAL, seconds, 1.0))


def _limit_memory(memory: int, stack: contextlib.ExitStack) -> None:
    if sys.platform != "linux":
        return
    import resource

    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    ends = [end for end in (now + memory, soft, hard) if end != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min(ends), hard))
    stack.callback(resource.setrlimit, resource.RLIMIT_AS, (soft, hard))
