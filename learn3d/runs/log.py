"""The record of a run: progress on the terminal, metrics.jsonl, journal.txt, TensorBoard.

Nothing here stops a run: what cannot be written is said once and, where it can be, written later.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from tqdm import tqdm

from learn3d.config import TrainConfig
from learn3d.files import writing
from learn3d.runs.checkpoint import Progress
from learn3d.runs.folder import JOURNAL, METRICS, TENSORBOARD
from learn3d.terminal import is_watched, note, plain

MEAN_OVER = 20  # steps: those of both turns, where a method trains its networks in turns


class RunLog:
    """Writes what a run reports; use it as a context manager. Steps after `start` of an earlier attempt are forgotten.

    On a terminal it shows a progress bar with the losses and the time left; elsewhere it prints a line at most every
    `seconds_between_lines` seconds. Each loss that is shown is a mean over the last steps that computed it. Raises
    OSError where the files cannot be opened at the start; after that a full disk, a broken TensorBoard or a closed
    terminal is a warning.
    """

    def __init__(self, folder: Path, *, start: int, total: int, seconds_between_lines: float = 30.0) -> None:
        self.folder = Path(folder)
        self.start = start
        self.total = total
        self.seconds_between_lines = seconds_between_lines
        self._warned: set[str] = set()
        self._recent: dict[str, deque[float]] = {}
        for name in (METRICS, JOURNAL):  # a pipe would be waited for; a link would have lines appended anywhere
            if (path := self.folder / name).is_symlink() or (path.exists() and not path.is_file()):
                raise OSError(f"{path} is no plain file, and nothing is appended to it; move it away")
        _forget_after(self.folder / METRICS, start)
        self._metrics = _Lines(self.folder / METRICS)
        self._journal = _Lines(self.folder / JOURNAL)
        self._bar = None
        if is_watched():
            self._bar = tqdm(total=total, initial=start, unit="step", dynamic_ncols=True)
        self._tensorboard: Any = None
        with self._tensorboard_may_fail():
            from torch.utils.tensorboard import SummaryWriter

            self._tensorboard = SummaryWriter(str(self.folder / TENSORBOARD), purge_step=start + 1)
        self._started = self._last_line = time.monotonic()

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is not None:  # whoever catches it shows it on the terminal
            self.note(f"ended by {type(error).__name__}: {error}" if str(error) else f"ended by {type(error).__name__}")
        self.sync()
        self._on_bar("close")
        self._to_tensorboard("close")
        self._metrics.close()
        self._journal.close()

    def step(self, step: int, losses: Mapping[str, float]) -> None:
        """Show that a step is done."""
        for name, value in losses.items():
            self._recent.setdefault(name, deque(maxlen=MEAN_OVER)).append(value)
        if self._bar is not None:
            if step % 5 == 0:
                self._on_bar("set_postfix_str", self._means(), refresh=False)
            self._on_bar("update", step - self._bar.n)
            return
        now = time.monotonic()
        if now - self._last_line >= self.seconds_between_lines or step in (self.start + 1, self.total):
            self._last_line = now
            seconds_per_step = (now - self._started) / (step - self.start)
            left = datetime.timedelta(seconds=round(seconds_per_step * (self.total - step)))
            note(f"step {step}/{self.total}  {self._means()}  {1000 * seconds_per_step:.0f} ms/step, {left} left")

    def _means(self) -> str:
        names = sorted(self._recent, key=lambda name: name != "total")
        return "  ".join(f"{name} {sum(self._recent[name]) / len(self._recent[name]):.3g}" for name in names)

    def _on_bar(self, call: str, *arguments: Any, **options: Any) -> None:
        """One call of the progress bar, if there is one; that the terminal has been closed does no harm."""
        if self._bar is not None:
            with contextlib.suppress(OSError, ValueError):
                getattr(self._bar, call)(*arguments, **options)

    def metrics(self, step: int, split: str, values: Mapping[str, Any]) -> None:
        """Append one line to metrics.jsonl and the same numbers to TensorBoard, under `split`/."""
        self._write(self._metrics, json.dumps({"step": step, "split": split, **values}))
        for name, value in values.items():
            if isinstance(value, (int, float)):
                self._to_tensorboard("add_scalar", f"{split}/{name}", value, step)

    def picture(self, step: int, name: str, rgb: np.ndarray) -> None:
        """Add a picture uint8 [H,W,3] to TensorBoard."""
        self._to_tensorboard("add_image", name, rgb, step, dataformats="HWC")

    def say(self, text: str) -> None:
        """Print a line without breaking the progress bar, and note it in journal.txt."""
        if self._bar is not None:
            self._on_bar("write", plain(text), file=sys.stderr)
        else:
            note(text)
        self.note(text)

    def note(self, text: str) -> None:
        """Note a line in journal.txt alone."""
        now = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
        self._write(self._journal, f"{now} {plain(text)}")

    def warn(self, what: str, error: BaseException, then: str) -> None:
        """Say once that something could not be done, and what follows from that."""
        if what not in self._warned:
            self._warned.add(what)
            self.say(f"warning: {what} ({error}); {then}")

    def sync(self) -> None:
        """Put on the disk what was reported so far, so that a checkpoint never lacks the metrics of its steps."""
        for lines in (self._metrics, self._journal):
            self._write(lines, None)
        self._to_tensorboard("flush")

    def _write(self, lines: _Lines, text: str | None) -> None:
        """Append a line; without one, put everything on the disk."""
        try:
            lines.append(text) if text is not None else lines.sync()
        except OSError as error:
            what = f"{lines.path.name} cannot be written"
            self.warn(what, error, "training goes on, and what is missing is written when there is room again")

    @contextlib.contextmanager
    def _tensorboard_may_fail(self) -> Iterator[None]:
        """Go on without TensorBoard where the block fails. Its thread reports errors of earlier calls, of any class."""
        try:
            yield
        except Exception as error:
            self._tensorboard = None
            self.warn("tensorboard does not work", error, "metrics go to metrics.jsonl only")

    def _to_tensorboard(self, call: str, *arguments: Any, **options: Any) -> None:
        with self._tensorboard_may_fail():
            if self._tensorboard is not None:
                getattr(self._tensorboard, call)(*arguments, **options)


class _Lines:
    """A file that lines are appended to. What cannot be written waits for the next call."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = open(path, "ab", buffering=0)
        self._waiting = b""

    def append(self, text: str) -> None:
        """Write a line, after those that wait. Raises OSError where that fails, and keeps it."""
        self._waiting += text.encode() + b"\n"
        self._flush()

    def sync(self) -> None:
        """Write what waits and put the file on the disk."""
        self._flush()
        os.fsync(self._file.fileno())

    def _flush(self) -> None:
        while self._waiting:  # a disk may take the first half of a line
            self._waiting = self._waiting[self._file.write(self._waiting) :]

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._file.close()


def open_log(config: TrainConfig, progress: Progress, is_main: bool) -> RunLog | SilentLog:
    """The log of a run that goes on at `progress`; processes other than rank 0 report nothing."""
    return RunLog(config.output, start=progress.step, total=config.iterations) if is_main else SilentLog()


class SilentLog:
    """What a process that does not report has in place of a `RunLog`: every call does nothing."""

    def __enter__(self) -> SilentLog:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *arguments, **options: None


def _forget_after(path: Path, step: int) -> None:
    """Drop metrics of steps after `step`, and a last line cut short by a crash: the resumed run writes them again."""
    if not path.exists():
        return
    kept = []
    for line in path.read_bytes().splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line + b"\n")
        except (ValueError, KeyError, TypeError, RecursionError):  # not JSON, not UTF-8; JSON of another form
            continue
    writing.write_bytes(path, b"".join(kept), sync=True)
