"""Draws voxel IoU and MMD over the training, from the curves in docs/results/*.json: a column for each category.

python docs/draw_curves.py --output results-curves.png kato-5000 ablation-5000=fp32

The name of a file may be followed by a word for its data. Files with the same word are drawn together, and the longer
curve of a run counts. Several seeds are drawn as their mean, in the band from the lowest to the highest. If a file has
the IoU of the mean shape (of the test objects), it is a dashed line. One category alone has its panels side by side; if
its files have them, a third one shows the IoU of silhouettes by the angle from the input's view.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

RESULTS = Path(__file__).parent / "results"
STEP_IMAGES = 128  # the methods have steps of different sizes, so steps are counted in images
METHODS = {
    "vanilla": ("Vanilla-AE", "#d1495b"),
    "without-adversarial": ("without the adversarial loss", "#edae49"),
    "without-prior": ("without the prior", "#8d6cab"),
    "proposed": ("Proposed", "#00798c"),
    "plus": ("Plus", "#7a7a7a"),
}
Tables = dict[str, list[list[str]]]
# rows of numbers by panel, method and seed
Curves = dict[str, dict[str, dict[str, np.ndarray]]]


def _read(files: list[str]) -> Iterator[tuple[str, Tables]]:
    """The word for the data of each file, and its tables."""
    for file in files:
        name, _, kind = file.partition("=")
        yield kind, json.loads((RESULTS / f"{name}.json").read_text())


def _add_runs(curves: Curves, kind: str, points: dict[str, list[list[float]]]) -> None:
    """Add runs <category>/<method>-seed<k>; the longer curve of a run counts."""
    for run, rows in points.items():
        category, _, method_seed = run.partition("/")
        method, _, seed = method_seed.rpartition("-seed")
        seeds = curves.setdefault(f"{kind} {category}".strip(), {}).setdefault(method, {})
        if len(rows) > len(seeds.get(seed, ())):
            seeds[seed] = np.array(rows)


def read_curves(files: list[str]) -> Curves:
    """The validations of the methods of the figure: rows of step, IoU and MMD."""
    curves: Curves = {}
    for kind, tables in _read(files):
        images = {run: int(batch) for run, _, _, batch, *_ in tables["runs"][1:]}
        points: dict[str, list[list[float]]] = {}
        for run, _, step, *values in tables["curves"][1:]:
            numbers = [np.nan if value == "-" else float(value) for value in values]
            points.setdefault(run, []).append([int(step) * images[run] / STEP_IMAGES, *numbers])
        _add_runs(curves, kind, points)
    return curves


def read_angles(files: list[str]) -> Curves:
    """The IoU of silhouettes of the last networks: rows of angle and IoU."""
    curves: Curves = {}
    for kind, tables in _read(files):
        (_, *angles), *runs = tables.get("angles", [[""]])
        _add_runs(
            curves,
            kind,
            {
                run: [[int(a), float(v)] for a, v in zip(angles, row, strict=True) if v != "-"]
                for run, *row in runs
            },
        )
    return curves


def read_mean_shapes(files: list[str]) -> dict[str, float]:
    """The voxel IoU of the mean shape by panel."""
    found = {}
    for kind, tables in _read(files):
        (_, _, *categories), *rows = tables.get("main", [["", ""]])
        for label, _, *values in rows:
            if label == "Mean shape":
                for category, value in zip(categories, values, strict=True):
                    found[f"{kind} {category}".strip()] = float(value.split()[0])
    return found


def draw(curves: Curves, mean_shapes: dict[str, float], angles: Curves) -> Figure:
    """IoU above, MMD below it; of one category IoU, MMD and, if given, the angles, side by side."""
    alone = len(curves) == 1
    count = 3 if alone and angles else 2
    rows, columns = (1, count) if alone else (2, len(curves))
    size = (3.2 * count, 2.9) if alone else (2.6 * columns + 0.4, 4.6)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).reshape(count, -1)
    for column, (title, methods) in enumerate(curves.items()):
        if not alone:
            axes[0, column].set_title(title)
        for panel in axes[:2, column] if alone else axes[1:2, column]:
            panel.set_xlabel(f"steps of {STEP_IMAGES} images")
        for row in range(2):
            _draw_methods(axes[row, column], methods, 1 + row)
        if title in mean_shapes:
            style = {"color": "black", "ls": "--", "lw": 1, "label": "mean shape"}
            axes[0, column].axhline(mean_shapes[title], **style)
        if count == 3:
            _draw_methods(axes[2, column], angles.get(title, {}), 1)
            axes[2, column].set_xlabel("degrees from the input's view")
    axes[0, 0].set_ylabel("voxel IoU")
    axes[1, 0].set_ylabel("MMD: pose in the code")
    if count == 3:
        axes[2, 0].set_ylabel("IoU of silhouettes")
    for panel in axes[1]:
        panel.set_ylim(bottom=0)
    for panel in axes.flat:
        panel.grid(color="#e6e6e6")
        panel.spines[["top", "right"]].set_visible(False)
    legend = {line.get_label(): line for panel in axes[0] for line in panel.get_lines()}
    figure.legend(
        legend.values(), legend.keys(), loc="outside upper center", ncols=len(legend), frameon=False
    )
    return figure


def _draw_methods(axes: Axes, methods: dict[str, dict[str, np.ndarray]], place: int) -> None:
    """Column `place` of the rows of each method above the first column."""
    for method in [name for name in METHODS if name in methods]:
        label, color = METHODS[method]
        seeds = list(methods[method].values())
        shared = np.stack([rows[: min(map(len, seeds))] for rows in seeds])
        steps, values = shared[0, :, 0], shared[:, :, place]
        axes.plot(steps, values.mean(0), color=color, label=label)
        axes.fill_between(steps, values.min(0), values.max(0), color=color, alpha=0.2, lw=0)


def main(files: Annotated[list[str], tyro.conf.Positional], output: Path) -> None:
    figure = draw(read_curves(files), read_mean_shapes(files), read_angles(files))
    figure.savefig(output, dpi=120)


if __name__ == "__main__":
    tyro.cli(main)
