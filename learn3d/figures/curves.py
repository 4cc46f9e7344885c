"""Learning curves from the metrics.jsonl of runs: a line per kind of run, a band over its seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from learn3d.figures import plots
from learn3d.files import limits
from learn3d.files.reading import parse_json, read_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: What the axes say; other names are shown as they are logged.
TITLES = {
    "projection": "projection loss (1 - IoU)",
    "smoothness": "smoothness loss",
    "prior": "prior loss",
    "confusion": "confusion loss (adversarial)",
    "classification": "classification loss (discriminator)",
    "total": "total loss (weighted)",
    "voxel_iou": "voxel IoU",
    "voxel_iou_kato19": "voxel IoU (kato19)",
    "precision": "precision of voxels",
    "recall": "recall of voxels",
    "chamfer_l1": "Chamfer-L1 distance",
    "f_score": "F-score",
    "silhouette_iou": "silhouette IoU",
    "mmd": "MMD between views",
    "mmd_paper": "MMD, printed formula",
}
_FIRST = ("voxel_iou", "mmd", "projection", "total")  # panels in this order, then as they come
_NOT_CURVES = {"images", "undefined", "hollow", "without_distance", "mmd_codes", "seconds"}
_NOT_CURVES |= {"voxel_iou_kato18"}  # it is what voxel_iou is


@dataclass(frozen=True, eq=False)
class Curve:
    """One logged number of one run over its steps."""

    steps: np.ndarray  # int64 [T], ascending
    values: np.ndarray  # float64 [T]


Key = tuple[str, str]  # split ("train", "val" ...) and name of a number


def read_metrics(path: Path) -> dict[Key, Curve]:
    """All curves of a run folder (or of a metrics.jsonl), by split and name.

    A last line cut short is left out: the run may be writing it. Raises FileNotFoundError without such a file and
    ValueError for one above 256 MiB and, naming it, for a line that is not a record of a run.
    """
    path = Path(path)
    file = path / "metrics.jsonl" if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(f"there is no {file}; give the folder of a training run, which has a metrics.jsonl")
    lines = read_text(file, limits.METRICS_BYTES, "the metrics of a run", errors="replace").splitlines()
    points: dict[Key, dict[int, float]] = {}
    for number, line in enumerate(lines, start=1):
        try:
            record = parse_json(line, finite=False)
            step, split = record.pop("step"), str(record.pop("split"))
            if type(step) is not int or not 0 <= step <= limits.ITERATIONS:
                raise ValueError("no step")
        except (KeyError, TypeError, AttributeError, ValueError):
            if number == len(lines) and number > 1:
                break
            raise ValueError(f"{file}, line {number} is no record with a step and a split: {line[:60]!r}") from None
        for name, value in record.items():
            if isinstance(value, (int, float)) and not isinstance(value, bool) and name not in _NOT_CURVES:
                if not name.isprintable() or not split.isprintable() or len(name + split) > limits.CURVE_NAME:
                    at_fault = f"{split} {name}"[: limits.CURVE_NAME]
                    raise ValueError(f"{file}, line {number} has a number whose name is none: {at_fault!r}")
                points.setdefault((split, name), {})[step] = float(value)
    if not points:
        raise ValueError(f"{file} holds no numbers yet; let the run take some steps first")
    if len(points) > limits.CURVES:
        raise ValueError(f"{file} holds {len(points)} different numbers; at most {limits.CURVES} are drawn")
    return {key: Curve(*(np.array(x) for x in zip(*sorted(p.items()), strict=True))) for key, p in points.items()}


def band(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps int64 [T] that all curves have, and mean, lowest and highest value at each, float64 [T]."""
    steps = curves[0].steps
    for curve in curves[1:]:
        steps = np.intersect1d(steps, curve.steps)
    rows = np.stack([curve.values[np.isin(curve.steps, steps)] for curve in curves])
    return steps, rows.mean(axis=0), rows.min(axis=0), rows.max(axis=0)


@plots.styled
def plot_curves(runs: Mapping[str, Sequence[Mapping[Key, Curve]]]) -> Figure:
    """A panel for every logged number; in it a line per label, the mean over its runs, with their range as a band.

    runs: for each label the curves (`read_metrics`) of one run or of several that differ in their seed.
    """
    from matplotlib.figure import Figure

    keys = panels(runs)
    columns = min(3, len(keys))
    rows = math.ceil(len(keys) / columns)
    figure = Figure(figsize=(3.5 * columns, 2.5 * rows + 0.4))
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, key in zip(grid.flat, keys, strict=False):
        _draw_panel(axes, key, runs)
    for axes in grid.flat[len(keys) :]:
        axes.set_visible(False)
    last_step = max(curve.steps[-1] for curves in runs.values() for run in curves for curve in run.values())
    for axes in grid.flat[: len(keys)]:
        axes.set_xlim(0, 1.02 * last_step)
    for axes in grid.flat[max(0, len(keys) - columns) : len(keys)]:
        axes.set_xlabel("training step")
    _add_legend(figure, runs)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.35 / figure.get_figheight()))
    return figure


def panels(runs: Mapping[str, Sequence[Mapping[Key, Curve]]]) -> list[Key]:
    """Which numbers to show, in order: validation first, then losses."""
    keys = list(dict.fromkeys(key for curves in runs.values() for run in curves for key in run))
    if not keys:
        raise ValueError("give at least one run to draw curves of")

    def rank(key: Key) -> tuple[bool, int]:
        return key[0] == "train", _FIRST.index(key[1]) if key[1] in _FIRST else len(_FIRST)

    return sorted(keys, key=rank)


def _draw_panel(axes: Axes, key: Key, runs: Mapping[str, Sequence[Mapping[Key, Curve]]]) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    split, name = key
    for index, curves in enumerate(runs.values()):
        known = [run[key] for run in curves if key in run]
        if not known:
            continue
        steps, mean, low, high = band(known)
        marker = {"marker": "o", "markersize": 3} if len(steps) <= 30 else {}
        axes.plot(steps, mean, **plots.line_style(index), **marker)
        if len(known) > 1:
            axes.fill_between(steps, low, high, color=plots.line_style(index)["color"], alpha=0.2, linewidth=0)
    axes.set_title(f"{TITLES.get(name, name)}, {split}", loc="left")
    if split == "train" and all(curve[key].values.min() > 0 for run in runs.values() for curve in run if key in curve):
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_locator(NullLocator())


def _add_legend(figure: Figure, runs: Mapping[str, Sequence[Mapping[Key, Curve]]]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **plots.line_style(index)) for index in range(len(runs))]
    labels = [f"{label} ({len(r)} seeds: mean and range)" if len(r) > 1 else label for label, r in runs.items()]
    figure.legend(handles, labels, loc="upper left", ncols=min(4, len(labels)), fontsize=9)
