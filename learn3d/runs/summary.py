"""The first and the last lines of a run's log."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from learn3d.config import TrainConfig
from learn3d.data.dataset import ViewDataset
from learn3d.methods.method import is_compact
from learn3d.presets import PRESETS
from learn3d.runs.checkpoint import Progress
from learn3d.runs.state import Run
from learn3d.runs.threads import ThreadTuner


def describe_run(
    run: Run, progress: Progress, train_set: ViewDataset, val_set: ViewDataset, threads: ThreadTuner
) -> str:
    """Method, data and device of a run that begins or continues; mirror plane and generator if the masks decide."""
    config = run.config
    where = f"{config.device}, {config.precision}, {threads}"
    data = f"{len(train_set)} images of {train_set.num_objects} objects; {config.val_split}: {len(val_set)} images"
    verb = f"resuming at step {progress.step}" if progress.step else "training"
    name = f"{PRESETS[config.preset].label} ({config.preset})"
    text = f"{verb}: {name} on {config.category}, {data}; {where}; output {config.output}"
    if config.settings.wants_mirror_plane and run.info.mirror_plane_deg is None:
        text += "\nno mirror plane found in the masks (about 150 are needed); set it with --symmetry"
    elif config.settings.wants_mirror_plane:
        azimuth = f"{run.info.mirror_plane_deg:g}"
        text += f"\nmirror plane: along the viewing direction of azimuth {azimuth}, found from the masks"
    if config.settings.wants_solidity:
        kind = "compact" if is_compact(run.info) else "not compact"
        text += f"\nobjects: {kind}, as masks fill {run.info.solidity:.2f} of their convex hulls"
    return text


@dataclass(frozen=True)
class Summary:
    """The result of a call of `train`."""

    folder: Path
    step: int
    finished: bool  # False if a signal stopped it
    best_iou: float
    best_step: int
    seconds: float  # duration of this call
    total_seconds: float  # training time, over all resumptions

    @classmethod
    def of(cls, config: TrainConfig, progress: Progress, started: float) -> Summary:
        """The summary of a call that began at `time.monotonic()` = `started`."""
        finished, best = progress.step == config.iterations, (progress.best_iou, progress.best_step)
        return cls(config.output, progress.step, finished, *best, time.monotonic() - started, progress.seconds)

    def __str__(self) -> str:
        """One line for the terminal."""
        end = f"{'finished' if self.finished else 'stopped'} at step {self.step} after {self.seconds / 60:.1f} min"
        if self.total_seconds > self.seconds + 1:
            end += f" ({self.total_seconds / 60:.1f} min of training in all)"
        best = f"best validation IoU {self.best_iou:.4f} at step {self.best_step}; " if self.best_step else ""
        return f"{end}; {best}everything is in {self.folder}"
