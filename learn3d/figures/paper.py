"""The paper's figures, each from opened runs into files; the functions that `learn3d figures` calls."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from learn3d.config import differences, load_config
from learn3d.figures import plots
from learn3d.figures.curves import Log, read_metrics
from learn3d.figures.grids import FRAME_SIZE, comparison_grid, interpolate, spread_views
from learn3d.figures.runs import Run, name_runs
from learn3d.pictures.sheets import save_gif, save_png, stack, tile


def save_grid(
    runs: Sequence[Run], output: Path, *, images: int = 6, indices: Sequence[int] = (), truth: bool = False
) -> list[Path]:
    """Reconstructions of test images, the runs of a category below each other, as a PNG.

    images: how many of each category, chosen by `spread_views`. indices: samples to show instead, of every category.
    truth: show the true voxels, too.
    """
    blocks, datasets = [], {id(run.dataset): run.dataset for run in runs}
    for dataset in datasets.values():
        samples = torch.tensor(indices) if indices else spread_views(dataset, images)
        methods = [(run.label, run.method) for run in runs if run.dataset is dataset]
        title = dataset.category if len(datasets) > 1 else "input"
        blocks.append(comparison_grid(methods, dataset, samples, truth=truth, title=title))
    output.parent.mkdir(parents=True, exist_ok=True)
    path = output.with_suffix(".png")
    save_png(path, stack(blocks, gap=10))
    return [path]


def save_tsne(runs: Sequence[Run], output: Path) -> list[Path]:
    """Shape codes of test images in the plane, coloured by the view, a map per run, as PNG and SVG."""
    return plots.save_figure(plots.draw_tsne(runs), output)


def save_interpolation(
    runs: Sequence[Run], output: Path, *, images: int = 3, indices: Sequence[int] = ()
) -> list[Path]:
    """Shapes between those of some test images: a strip per run as PNG, and an endless walk as GIF.

    images: how many, of different objects seen from the same side; indices: samples to use instead.
    """
    strips, walks = [], []
    for run in runs:
        samples = torch.tensor(indices) if indices else spread_views(run.dataset, images, turn_deg=0)
        title = run.label if len(runs) > 1 else "input"
        strip, frames = interpolate(run.method, run.dataset, samples, title=title)
        strips.append(strip)
        walks.append(frames)
    names = [run.label for run in runs] if len(runs) > 1 else ()
    frames = [tile(rows, tile_size=FRAME_SIZE, row_titles=names) for rows in zip(*walks, strict=True)]
    output.parent.mkdir(parents=True, exist_ok=True)
    paths = [output.with_suffix(".png"), output.with_suffix(".gif")]
    save_png(paths[0], stack(strips, gap=10))
    save_gif(paths[1], np.stack(frames))
    return paths


def save_curves(paths: Sequence[Path], output: Path, *, labels: Sequence[str] = ()) -> list[Path]:
    """Learning curves of run folders as PNG and SVG; runs of one label are one line with a band.

    By default these are runs that differ in their seed alone.
    """
    if not paths:
        raise ValueError("give at least one run folder to draw")
    lines: dict[str, list[Log]] = {}
    logs = [read_metrics(path) for path in paths]
    for label, log in zip(name_runs((), paths, labels) if labels else _name_lines(paths), logs, strict=True):
        lines.setdefault(label, []).append(log)
    return plots.save_figure(plots.draw_curves(lines), output)


def _name_lines(paths: Sequence[Path]) -> list[str]:
    """Names of runs, the same for runs that differ in their seed alone."""
    configs = [load_config(path / "config.json") for path in paths]
    alike = [[not differences(dataclasses.replace(a, seed=b.seed), b) for b in configs].index(True) for a in configs]
    kinds = sorted(set(alike))
    names = name_runs([configs[k] for k in kinds], [paths[k] for k in kinds])
    return [names[kinds.index(k)] for k in alike]


def save_polar(runs: Sequence[Run], output: Path) -> list[Path]:
    """Voxel IoU with the truth, and among the shapes of an object, by the azimuth of the view, as PNG and SVG."""
    return plots.save_figure(plots.draw_polar(runs), output)


def save_all(
    runs: Sequence[Run],
    paths: Sequence[Path],
    folder: Path,
    *,
    labels: Sequence[str] = (),
    say: Callable[[str], None] = lambda text: None,
) -> list[Path]:
    """Every figure with its defaults, into files of these names in `folder`; returns the files that were written.

    runs: `paths`, opened. What cannot be drawn is said, with the reason.
    """
    written = []
    figures: dict[str, Callable[..., list[Path]]] = {"grid": save_grid, "tsne": save_tsne}
    figures |= {"interpolation": save_interpolation, "polar": save_polar, "curves": save_curves}
    for name, save in figures.items():
        say(f"drawing {name}")
        try:
            target = folder / name
            written += save_curves(paths, target, labels=labels) if save is save_curves else save(runs, target)
        except (ValueError, OSError) as error:
            say(f"not drawn: {name}: {error}")
    return written
