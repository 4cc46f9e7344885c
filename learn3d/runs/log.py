"""The record of a run: progress on the terminal, metrics.jsonl, TensorBoard."""

from __future__ import annotations

import datetime
import json
import os
import sys
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from learn3d.files import writing
from learn3d.runs.folder import METRICS, TENSORBOARD
from learn3d.terminal import is_watched, note

SECONDS_BETWEEN_LINES = 30.0
MEAN_OVER = 20  # steps: those of both turns, if a method trains its networks in turns


class RunLog:
    """Writes the reports of a run; use it as a context manager. Steps after `start` of an earlier attempt are dropped.

    On a terminal it shows a progress bar with the losses and the time left; elsewhere it prints a line now and then.
    Each loss that is shown is a mean over the last steps that computed it. A closed terminal does no harm. Raises
    OSError if a file cannot be written.
    """

    def __init__(self, folder: Path, *, start: int, total: int) -> None:
        self.start, self.total = start, total
        self._recent: dict[str, deque[float]] = {}
        _drop_after(folder / METRICS, start)
        self._metrics = open(folder / METRICS, "ab")
        self._bar = tqdm(total=total, initial=start, unit="step", dynamic_ncols=True) if is_watched() else None
        self._tensorboard: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter

            self._tensorboard = SummaryWriter(str(folder / TENSORBOARD), purge_step=start + 1)
        except (
            ImportError,
            TypeError,
            AttributeError,
        ) as error:  # not installed, or beside packages that do not fit it
            self.say(f"warning: tensorboard does not work ({error}); metrics go to {METRICS} only")
        self._started = self._last_line = time.monotonic()

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
        self._metrics.close()
        if self._tensorboard is not None:
            self._tensorboard.close()

    def step(self, step: int, losses: Mapping[str, float]) -> None:
        """Show that a step is done."""
        for name, value in losses.items():
            self._recent.setdefault(name, deque(maxlen=MEAN_OVER)).append(value)
        if self._bar is not None:
            if step % 5 == 0:
                self._bar.set_postfix_str(self._means(), refresh=False)
            self._bar.update(step - self._bar.n)
            return
        now = time.monotonic()
        if now - self._last_line >= SECONDS_BETWEEN_LINES or step in (self.start + 1, self.total):
            self._last_line = now
            seconds_per_step = (now - self._started) / (step - self.start)
            left = datetime.timedelta(seconds=round(seconds_per_step * (self.total - step)))
            note(f"step {step}/{self.total}  {self._means()}  {1000 * seconds_per_step:.0f} ms/step, {left} left")

    def _means(self) -> str:
        names = sorted(self._recent, key=lambda name: name != "total")
        return "  ".join(f"{name} {sum(self._recent[name]) / len(self._recent[name]):.3g}" for name in names)

    def metrics(self, step: int, split: str, values: Mapping[str, Any]) -> None:
        """Append one line to metrics.jsonl and the same numbers to TensorBoard, under `split`/."""
        self._metrics.write(json.dumps({"step": step, "split": split, **values}).encode() + b"\n")
        self._metrics.flush()
        for name, value in values.items():
            if self._tensorboard is not None and isinstance(value, (int, float)):
                self._tensorboard.add_scalar(f"{split}/{name}", value, step)

    def picture(self, step: int, name: str, rgb: np.ndarray) -> None:
        """Add a picture uint8 [H,W,3] to TensorBoard."""
        if self._tensorboard is not None:
            self._tensorboard.add_image(name, rgb, step, dataformats="HWC")

    def say(self, text: str) -> None:
        """Print a line without breaking the progress bar."""
        with tqdm.external_write_mode(sys.stderr):
            note(text)

    def sync(self) -> None:
        """Put the reports so far on the disk, so that a checkpoint never lacks the metrics of its steps."""
        os.fsync(self._metrics.fileno())
        if self._tensorboard is not None:
            self._tensorboard.flush()


def _drop_after(path: Path, step: int) -> None:
    """Write the metrics again without those after `step`, and without a last line that a crash cut short.

    The file is a new one afterwards, so a link of that name leads nowhere.
    """
    kept = []
    for line in path.read_bytes().splitlines() if path.is_file() else []:
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line + b"\n")
        except (ValueError, KeyError, TypeError, RecursionError):  # not JSON, not UTF-8; JSON of another form
            continue
    writing.write_bytes(path, b"".join(kept), sync=True)
