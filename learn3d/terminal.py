"""The terminal: errors, lines and progress of a command, and signals that stop it."""

import contextlib
import difflib
import functools
import os
import re
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ParamSpec, TextIO

if TYPE_CHECKING:
    from tqdm import tqdm

P = ParamSpec("P")

SECONDS_BETWEEN_LINES = 30.0  # of progress, if stderr is no terminal
INTERRUPTED = 130  # exit status after Ctrl-C, as shells have it
#: Control characters, characters that change the direction of text, and surrogates, which cannot be encoded.
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
#: What torch says in a RuntimeError if there is too little memory.
_NO_MEMORY = re.compile(
    "bad_alloc|DefaultCPUAllocator|out of memory|an't allocate memory|can't start new thread"
)


def without_traceback(main: Callable[P, int]) -> Callable[P, int]:
    """Decorator of the main function of a command, which returns an exit status: errors become
    one line on stderr.

    ValueError, OSError, MemoryError, FloatingPointError and torch's errors for too little memory
    end it with status 1 and the line "error: " and the message. Ctrl-C ends it with status 130. Any
    other error is a bug and keeps its traceback.
    """

    @functools.wraps(main)
    def run(*arguments: P.args, **options: P.kwargs) -> int:
        try:
            return main(*arguments, **options)
        except (ValueError, OSError, FloatingPointError) as error:
            note(f"error: {error}")
            return 1
        except (MemoryError, RuntimeError) as error:
            if not lacks_memory(error):
                raise
            reason = (str(error).strip().splitlines() or ["MemoryError"])[0][:200]
            note(
                "error: there is too little memory; end other programs, or give a smaller batch, picture or data set "
                f"({reason})"
            )
            return 1
        except KeyboardInterrupt:
            note("interrupted; what was saved before is as it was")
            return INTERRUPTED

    return run


def lacks_memory(error: Exception) -> bool:
    """Whether an error of Python, NumPy or torch means that there is too little memory."""
    return isinstance(error, MemoryError) or bool(_NO_MEMORY.search(str(error)))


def plain(text: str) -> str:
    r"""Escape control characters (\x1b) except tabs and line ends: the text may have names from untrusted files."""
    return _CONTROLS.sub(lambda found: ascii(found[0])[1:-1], text)


def say(text: str) -> None:
    """Print a line of the results through `plain`. A closed pipe (`| head`) is no error.

    Raises OSError if the line cannot be written for another reason (a full disk), because the
    result is lost.
    """
    with contextlib.suppress(BrokenPipeError):
        _print(text, sys.stdout)


def note(text: str) -> None:
    """Print a line about the progress on stderr, apart from the results. Failures are ignored."""
    with contextlib.suppress(OSError, ValueError):  # ValueError: it was closed
        _print(text, sys.stderr)


def is_watched() -> bool:
    """Whether stderr is a terminal (it may be closed, or never have been open)."""
    return sys.stderr is not None and not sys.stderr.closed and sys.stderr.isatty()


def progress(
    items: Iterable[Any] | None, title: str | None, *, unit: str, total: int | None = None
) -> "tqdm":
    """Show on stderr how much of a loop over `items` is done: a bar on a terminal, elsewhere a
    line every 30 seconds. Without a title nothing is shown.

    items: None if the caller counts, by `update()` of the result. total: their number, if they
    have no length.
    """
    from tqdm import tqdm  # here, as `learn3d --help` and errors work without it

    options: dict[str, Any] = {"dynamic_ncols": True}
    if not is_watched():
        wait = dict.fromkeys(("delay", "mininterval", "maxinterval"), SECONDS_BETWEEN_LINES)
        form = "{desc}: {n_fmt} of {total_fmt}, {remaining} left"
        options = wait | {"file": _Lines(), "bar_format": form, "miniters": 1, "leave": False}
        options |= {"position": 0}  # else a second loop within this one moves the cursor
    return tqdm(items, title and plain(title), total, unit=unit, disable=title is None, **options)


class _Lines:
    """A file for tqdm that passes each of its states to `note`, as a line."""

    def write(self, text: str) -> None:
        if state := text.strip():  # without the carriage return before it
            note(state)

    def flush(self) -> None:
        pass


def _print(text: str, stream: TextIO | None) -> None:
    if stream is None:  # closed before the program began; print would take stdout
        return
    try:
        print(plain(text), file=stream, flush=True)
    except OSError:
        _silence(stream)
        raise


def _silence(stream: TextIO) -> None:
    """Let no further output fail.

    Python flushes once more when it ends: "Note on SIGPIPE" of module `signal`.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextlib.contextmanager
def closed_pipe_ends() -> Iterator[None]:
    """End the program in good order if its output goes to a closed pipe (`| head`) within this
    context.
    """
    try:
        try:
            yield
        finally:
            print(end="", flush=True)
    except BrokenPipeError:
        _silence(sys.stdout)
        raise SystemExit(0) from None


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """The error message for an unknown name: similar names, and all known ones."""
    known = list(known)
    near = " or ".join(map(repr, difflib.get_close_matches(name, known, n=2)))
    advice = f"did you mean {near}? There are" if near else "choose one of"
    return f"there is no {kind} {name!r}; {advice} {', '.join(known)}"


def align(rows: Sequence[Sequence[str]]) -> str:
    """Rows with the same number of cells as lines; each column is as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


@contextlib.contextmanager
def stop_on_signal() -> Iterator[SimpleNamespace]:
    """Turn the first SIGINT, SIGTERM or SIGHUP into a request to stop: the attribute `name` of
    the context, "" before.

    A second SIGINT interrupts at once. SIGHUP comes when the terminal is closed; if it is ignored
    (nohup), it stays ignored. Does nothing outside the main thread, because only this one can
    handle signals.
    """
    stop = SimpleNamespace(name="")
    previous = {}

    def handle(number: int, _: object) -> None:
        if stop.name and number == signal.SIGINT:
            raise KeyboardInterrupt
        if not stop.name and number == signal.SIGINT and sys.stderr.isatty():
            # os.write: print may be interrupted within itself
            os.write(sys.stderr.fileno(), b"\nstopping; a second Ctrl-C ends at once\n")
        stop.name = signal.Signals(number).name

    hangup = [] if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else [signal.SIGHUP]
    try:
        for number in (signal.SIGINT, signal.SIGTERM, *hangup):
            with contextlib.suppress(ValueError):  # not the main thread
                previous[number] = signal.signal(number, handle)
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
