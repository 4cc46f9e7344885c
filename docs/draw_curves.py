"""Draws voxel IoU and MMD over the training, from the curves in docs/results/*.json: a column for each category.

python docs/draw_curves.py --output results-curves.png kato-5000 ablation-5000=fp32

The name of a file may be followed by a word for its data. Files with the same word are drawn together, and the longer
curve of a run counts. Several seeds are drawn as their mean, in the band from the lowest to the highest.
"""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
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
# by panel, method and seed; rows of step, IoU and MMD
Curves = dict[str, dict[str, dict[str, np.ndarray]]]


def read_curves(files: list[str]) -> Curves:
    """The curves of the methods of the figure."""
    curves: Curves = {}
    for file in files:
        name, _, kind = file.partition("=")
        tables = json.loads((RESULTS / f"{name}.json").read_text())
        images = {run: int(batch) for run, _, _, batch, *_ in tables["runs"][1:]}
        points: dict[str, list[list[float]]] = {}
        for run, _, step, *values in tables["curves"][1:]:
            numbers = [np.nan if value == "-" else float(value) for value in values]
            points.setdefault(run, []).append([int(step) * images[run] / STEP_IMAGES, *numbers])
        for run, rows in points.items():
            category, _, method_seed = run.partition("/")
            method, _, seed = method_seed.rpartition("-seed")
            seeds = curves.setdefault(f"{kind} {category}".strip(), {}).setdefault(method, {})
            if len(rows) > len(seeds.get(seed, ())):
                seeds[seed] = np.array(rows)
    return curves


def draw(curves: Curves) -> Figure:
    """IoU above, MMD below."""
    figure = Figure(figsize=(max(2.6 * len(curves) + 0.4, 4.8), 4.6), layout="constrained")
    axes = figure.subplots(2, len(curves), sharex="col", squeeze=False)
    for column, (title, methods) in enumerate(curves.items()):
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel(f"steps of {STEP_IMAGES} images")
        for method in [name for name in METHODS if name in methods]:
            label, color = METHODS[method]
            seeds = list(methods[method].values())
            shared = np.stack([rows[: min(map(len, seeds))] for rows in seeds])
            for row in (0, 1):
                steps, values = shared[0, :, 0], shared[:, :, 1 + row]
                axes[row, column].plot(steps, values.mean(0), color=color, label=label)
                axes[row, column].fill_between(
                    steps, values.min(0), values.max(0), color=color, alpha=0.2, lw=0
                )
    axes[0, 0].set_ylabel("voxel IoU")
    axes[1, 0].set_ylabel("MMD: pose in the code")
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


def main(files: Annotated[list[str], tyro.conf.Positional], output: Path) -> None:
    draw(read_curves(files)).savefig(output, dpi=120)


if __name__ == "__main__":
    tyro.cli(main)
