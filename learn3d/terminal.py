"""What the tools share on the terminal: how a command ends, and tables of text."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import select
import sys
from collections.abc import Callable, Sequence
from typing import ParamSpec, TextIO

P = ParamSpec("P")

INTERRUPTED, UNREAD = 130, 141  # exit statuses after Ctrl-C, and after SIGPIPE, as shells have them
_NO_READER = (errno.EPIPE, errno.EIO)  # of a pipe; of a terminal that was closed
#: What a terminal would obey, what turns the direction of reading, and halves of characters, which cannot be written.
_COMMANDS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def in_a_sentence(*errors: type[Exception], label: Callable[[], str] = str) -> Callable[[Callable[P, int]], Callable]:
    """Decorates a tool's main, which returns its exit status: what stops it is a line on stderr, and no traceback.

    ValueError, OSError and the given errors: status 1 and "error: ", `label()` and what the error says. Ctrl-C: status
    130 and that it was interrupted. An output that nobody reads any more (`| head`): status 141 and no word. Files get
    their names when they are complete (`files.writing`), so that none of these leaves half of one. Anything else is a
    mistake of ours, and has its traceback.
    """

    def decorate(main: Callable[P, int]) -> Callable[P, int]:
        @functools.wraps(main)
        def ending(*arguments: P.args, **options: P.kwargs) -> int:
            _open_missing()
            try:
                status = main(*arguments, **options)
                if sys.stdout is not None:  # closed before the program began
                    sys.stdout.flush()
                return status
            except (ValueError, OSError, *errors) as error:
                if isinstance(error, BrokenPipeError) and _is_unread(sys.stdout):
                    return UNREAD
                note(f"error: {label()}{error}")
                return 1
            except KeyboardInterrupt:
                note("interrupted; what was saved before is as it was")
                return INTERRUPTED

        return ending

    return decorate


def plain(text: str) -> str:
    r"""The text with control characters but tabs and line ends written out (\x1b): names in it may be a stranger's."""
    return _COMMANDS.sub(lambda found: ascii(found[0])[1:-1], text)


def say(text: str, stream: TextIO | None = None) -> None:
    """Print a line of the results, as `plain` has it; where nobody reads it any more, that is no error.

    Raises OSError where it cannot be written for another reason (`> file` on a full disk): the result is lost then.
    """
    stream = stream or sys.stdout
    try:
        print(plain(text), file=stream, flush=True)
    except OSError as error:
        _silence(stream)
        if error.errno not in _NO_READER:
            raise


def note(text: str) -> None:
    """Print a line about the progress on stderr, apart from the results; no work ends because it cannot be written."""
    with contextlib.suppress(OSError):
        say(text, sys.stderr)


def _is_unread(stream: TextIO) -> bool:
    """Whether a stream is a pipe whose reader has gone; what waits to be written is dropped then."""
    with contextlib.suppress(OSError, AttributeError):  # no file at all; a system without poll (Windows)
        poll = select.poll()
        poll.register(stream.fileno(), select.POLLOUT)
        if any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0)):
            _silence(stream)
            return True
    return False


def _open_missing() -> None:
    """Let standard streams that were closed before the program began (`2>&-`) lead nowhere: the first files that are
    opened would take their numbers, and with them what libraries in C write there."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


def _silence(stream: TextIO) -> None:
    """Let a stream lead nowhere, also for the interpreter's own flush at the end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def align(rows: Sequence[Sequence[str]]) -> str:
    """Rows of equally many cells as lines, every column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)
