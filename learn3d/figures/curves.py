"""Numbers that plots and pages show: the log of a run over its steps, and means by azimuth."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from learn3d.files import limits
from learn3d.files.reading import parse_json, read_text

#: Okabe and Ito's colours, told apart with any kind of colour vision, darker ones first: yellow is too faint for lines.
COLORS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
#: Titles of panels. Other numbers have the name under which they are logged.
TITLES = {
    "projection": "projection loss (1 - IoU)",
    "smoothness": "smoothness loss",
    "prior": "prior loss",
    "confusion": "confusion loss (adversarial)",
    "classification": "classification loss (discriminator)",
    "total": "total loss (weighted)",
    "voxel_iou": "voxel IoU",
    "precision": "precision of voxels",
    "recall": "recall of voxels",
    "silhouette_iou": "silhouette IoU",
    "mmd": "MMD between views",
}
_FIRST = ("voxel_iou", "mmd", "projection", "total")  # panels in this order, then as they come
_NOT_CURVES = {"hollow", "seconds"}

SECTOR_DEG = 15
Key = tuple[str, str]  # split ("train", "val" ...) and name of a number
Curve = dict[int, float]  # value at each step, in the order of the steps
Log = dict[Key, Curve]  # all that a run has logged


def read_metrics(folder: Path) -> Log:
    """All curves of a run folder's metrics.jsonl, by split and name.

    A last line cut short is left out: the run may be writing it. Raises FileNotFoundError without such a file and
    ValueError for one above 256 MiB and, naming it, for a line that is not a record of a run.
    """
    file = Path(folder) / "metrics.jsonl"
    lines = read_text(file, limits.METRICS_BYTES, "the metrics of a run", errors="replace").splitlines()
    curves: Log = {}
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
            if type(value) in (int, float) and name not in _NOT_CURVES:
                if not (title := f"{split} {name}").isprintable() or len(title) > limits.CURVE_NAME:
                    wrong = title[: limits.CURVE_NAME]
                    raise ValueError(f"{file}, line {number} has a number whose name is none: {wrong!r}")
                curves.setdefault((split, name), {})[step] = float(value)
    if not 0 < len(curves) <= limits.CURVES:
        raise ValueError(f"{file} holds {len(curves)} different numbers; from 1 to {limits.CURVES} are drawn")
    return {key: dict(sorted(curve.items())) for key, curve in curves.items()}


def panels(runs: Iterable[Log]) -> list[Key]:
    """The numbers of all runs in the order in which they are shown: validation first, then losses."""
    keys = dict.fromkeys(key for run in runs for key in run)
    return sorted(keys, key=lambda key: (key[0] == "train", _FIRST.index(key[1]) if key[1] in _FIRST else len(_FIRST)))


def title_of(key: Key) -> str:
    """The title of a panel."""
    return f"{TITLES.get(key[1], key[1])}, {key[0]}"


def mean_by_azimuth(azimuths_deg: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(Azimuths float64 [D] of the sectors of 15 degrees that have images, mean of their values without NaN).

    The sectors are centred at 0, 15, 30 ...; azimuths_deg and values are float [M]. A mean of nothing is NaN.
    """
    sectors, ids = np.unique(np.round(azimuths_deg / SECTOR_DEG) % (360 / SECTOR_DEG), return_inverse=True)
    return SECTOR_DEG * sectors, np.array([mean(values[ids == number]) for number in range(len(sectors))])


def mean(values: np.ndarray) -> float:
    """Mean without NaN; NaN if nothing is left."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")
