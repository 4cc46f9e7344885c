"""The log of a run: progress on the terminal, metrics.jsonl, and TensorBoard or Weights & Biases."""

import contextlib
import datetime
import importlib.util
import json
import os
import sys
import time
import types
import uuid
from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from learn3d.config import TrainConfig, config_to_dict
from learn3d.distributed import rank
from learn3d.files import writing
from learn3d.files.reading import parse_json
from learn3d.runs.folder import METRICS, TENSORBOARD, WANDB_ID
from learn3d.terminal import SECONDS_BETWEEN_LINES, is_watched, note

MEAN_OVER = 20  # steps over which shown losses are averaged
#: Methods of a second log that writes nothing.
_SILENT = dict.fromkeys(("add_scalar", "add_image", "flush", "close"), lambda *_, **__: None)


class RunLog(contextlib.ExitStack):
    """The log of a run, a context manager.

    Metrics of steps after `start`, from before an interruption, are dropped.

    On a terminal it shows a progress bar with the losses and the time left; elsewhere it prints a
    line now and then. Shown losses are means over the last steps that computed them. Raises
    OSError if a file cannot be written.
    """

    def __init__(self, config: TrainConfig, *, start: int) -> None:
        super().__init__()
        self.start = start
        self.total = config.iterations
        self._recent: dict[str, deque[float]] = {}
        _drop_after(config.output / METRICS, start)
        self._metrics = self.enter_context(open(config.output / METRICS, "ab"))
        self._bar = None
        if is_watched():
            self._bar = self.enter_context(
                tqdm(total=self.total, initial=start, unit="step", dynamic_ncols=True)
            )
        try:
            self._writer = _open_writer(config, start)
        except (
            ImportError,
            TypeError,
            AttributeError,
        ) as error:  # missing, or in conflict with other packages
            self._writer = types.SimpleNamespace(**_SILENT)
            self.say(f"warning: {config.log} does not work ({error}); metrics go to {METRICS} only")
        self.callback(self._writer.close)
        self._after_first = self._last_line = time.monotonic()

    def step(self, step: int, losses: Mapping[str, float]) -> None:
        """Show the progress after a step."""
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
            text = f"step {step}/{self.total}  {self._means()}"
            if step == self.start + 1:
                self._after_first = now  # a first step takes longer than others
            else:
                seconds = (now - self._after_first) / (step - self.start - 1)
                left = datetime.timedelta(seconds=round(seconds * (self.total - step)))
                text += f"  {1000 * seconds:.0f} ms/step, {left} left"
            note(text)

    def _means(self) -> str:
        names = sorted(self._recent, key=lambda name: name != "total")
        return "  ".join(
            f"{name} {sum(self._recent[name]) / len(self._recent[name]):.3g}" for name in names
        )

    def metrics(self, step: int, split: str, values: Mapping[str, Any]) -> None:
        """Append one line to metrics.jsonl, and pass the numbers to the writer as <split>/<name>."""
        self._metrics.write(json.dumps({"step": step, "split": split, **values}).encode() + b"\n")
        self._metrics.flush()
        for name, value in values.items():
            if isinstance(value, (int, float)):
                self._writer.add_scalar(f"{split}/{name}", value, step)

    def picture(self, step: int, name: str, rgb: np.ndarray) -> None:
        """Pass a picture uint8 [H,W,3] to the writer."""
        self._writer.add_image(name, rgb, step, dataformats="HWC")

    def say(self, text: str) -> None:
        """Print a line without breaking the progress bar."""
        with tqdm.external_write_mode(sys.stderr):
            note(text)

    def sync(self) -> None:
        """Flush all metrics to the disk, before a checkpoint is saved."""
        os.fsync(self._metrics.fileno())
        self._writer.flush()


def open_log(config: TrainConfig, *, start: int) -> contextlib.AbstractContextManager[Any]:
    """The log of a run, see `RunLog`; for other ranks than 0 one that writes nothing."""
    if rank() == 0:
        return RunLog(config, start=start)
    silent = dict.fromkeys(("step", "metrics", "picture", "say", "sync"), lambda *_: None)
    return contextlib.nullcontext(types.SimpleNamespace(**silent))


def check_log(config: TrainConfig) -> None:
    """Raise a ValueError if the option log needs a package that is not installed."""
    if config.log == "wandb" and importlib.util.find_spec("wandb") is None:
        raise ValueError(
            "log 'wandb' needs the package wandb: pip install wandb, or choose tensorboard"
        )


def _open_writer(config: TrainConfig, start: int) -> Any:
    """The second log: TensorBoard's SummaryWriter, or an object with its methods."""
    if config.log == "wandb":
        return _open_wandb(config)
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(config.output / TENSORBOARD), purge_step=start + 1)


def _open_wandb(config: TrainConfig) -> types.SimpleNamespace:
    """A run in the project learn3d at Weights & Biases, which ignores steps that it already has."""
    import wandb

    path = config.output / WANDB_ID
    if not path.is_file():
        writing.write_bytes(path, uuid.uuid4().hex[:8].encode())
    options = {"id": path.read_text(), "resume": "allow", "config": config_to_dict(config)}
    try:
        run = wandb.init(project="learn3d", name=config.output.name, **options)
    except wandb.Error as error:
        advice = "call `wandb login`, or choose tensorboard"
        raise ValueError(f"log 'wandb' cannot begin a run ({error}); {advice}") from None
    return types.SimpleNamespace(
        add_scalar=lambda name, value, step: run.log({name: value}, step=step),
        add_image=lambda name, rgb, step, dataformats: run.log({name: wandb.Image(rgb)}, step=step),
        flush=lambda: None,  # wandb writes in its own process
        close=run.finish,
    )


def read_records(content: bytes) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """The intact lines of a metrics.jsonl, each with its record: step, split, and values by name."""
    for line in content.splitlines():
        with contextlib.suppress(ValueError):
            record = parse_json(line)
            if (
                isinstance(record, dict)
                and type(record.get("step")) is int
                and type(record.get("split")) is str
            ):
                yield line, record


def _drop_after(path: Path, step: int) -> None:
    """Write the metrics again, without steps after `step` and without damaged lines.

    A link of that name is replaced, not followed.
    """
    content = path.read_bytes() if path.is_file() else b""
    kept = [line + b"\n" for line, record in read_records(content) if record["step"] <= step]
    writing.write_bytes(path, b"".join(kept), sync=True)
