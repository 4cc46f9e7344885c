"""The record of a run: progress on the terminal, metrics.jsonl, TensorBoard."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from tqdm import tqdm

from learn3d import files

METRICS_FILE = "metrics.jsonl"


class RunLog:
    """Writes what a run reports; use it as a context manager. Steps after `start` of an earlier attempt are forgotten.

    On a terminal it shows a progress bar with the losses and the time left; elsewhere it prints a line at most every
    `seconds_between_lines` seconds.
    """

    def __init__(self, folder: Path, *, start: int, total: int, seconds_between_lines: float = 30.0) -> None:
        self.folder = Path(folder)
        self.start = start
        self.total = total
        self.seconds_between_lines = seconds_between_lines
        _forget_after(self.folder / METRICS_FILE, start)
        self._metrics = open(self.folder / METRICS_FILE, "a", encoding="utf-8")
        self._bar = tqdm(total=total, initial=start, unit="step", dynamic_ncols=True) if sys.stderr.isatty() else None
        self._tensorboard = _tensorboard_writer(self.folder / "tensorboard", start)
        self._started = self._last_line = time.monotonic()

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()
        if self._tensorboard is not None:
            self._tensorboard.close()
        self._metrics.close()

    def step(self, step: int, losses: Mapping[str, float]) -> None:
        """Show that a step is done."""
        if self._bar is not None:
            self._bar.update(step - self._bar.n)
            if step % 5 == 0:
                self._bar.set_postfix_str(_format(losses), refresh=False)
            return
        now = time.monotonic()
        if now - self._last_line >= self.seconds_between_lines or step in (self.start + 1, self.total):
            self._last_line = now
            seconds_per_step = (now - self._started) / (step - self.start)
            left = _duration(seconds_per_step * (self.total - step))
            text = f"step {step}/{self.total}  {_format(losses)}  {1000 * seconds_per_step:.0f} ms/step, {left} left"
            print(text, file=sys.stderr, flush=True)

    def metrics(self, step: int, split: str, values: Mapping[str, Any]) -> None:
        """Append one line to metrics.jsonl and the same numbers to TensorBoard, under `split`/."""
        self._metrics.write(json.dumps({"step": step, "split": split, **values}) + "\n")
        self._metrics.flush()
        if self._tensorboard is not None:
            for name, value in values.items():
                if isinstance(value, (int, float)):
                    self._tensorboard.add_scalar(f"{split}/{name}", value, step)

    def picture(self, step: int, name: str, rgb: np.ndarray) -> None:
        """Add a picture uint8 [H,W,3] to TensorBoard."""
        if self._tensorboard is not None:
            self._tensorboard.add_image(name, rgb, step, dataformats="HWC")

    def say(self, text: str) -> None:
        """Print a line without breaking the progress bar."""
        if self._bar is not None:
            self._bar.write(text, file=sys.stderr)
        else:
            print(text, file=sys.stderr, flush=True)


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
    files.write_bytes(path, b"".join(kept))


def _tensorboard_writer(folder: Path, start: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        print("tensorboard is not installed: metrics go to metrics.jsonl only", file=sys.stderr)
        return None
    return SummaryWriter(str(folder), purge_step=start + 1)


def _format(losses: Mapping[str, float]) -> str:
    return " ".join(f"{name[:6]} {value:.3g}" for name, value in losses.items())


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}"
