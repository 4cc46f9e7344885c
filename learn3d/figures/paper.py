"""The paper's figures, each from opened runs into files: the functions that `learn3d figures` calls."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from learn3d.data.dataset import ViewDataset
from learn3d.evaluation import spread_samples
from learn3d.figures import tsne
from learn3d.figures.grids import comparison_grid, interpolate
from learn3d.figures.runs import Run
from learn3d.pictures.sheets import save_png, stack


def save_grid(
    runs: Sequence[Run], output: Path, *, images: int = 6, indices: Sequence[int] = (), truth: bool = False
) -> list[Path]:
    """Reconstructions of test images, the runs of a category below each other, as a PNG.

    images: how many of each category, chosen by `choose_samples`. indices: samples to show instead, of every category.
    truth: show the true voxels, too.
    """
    blocks, datasets = [], {id(run.dataset): run.dataset for run in runs}
    for dataset in datasets.values():
        samples = choose_samples(dataset, images, indices)
        methods = [(run.label, run.method) for run in runs if run.dataset is dataset]
        title = dataset.category if len(datasets) > 1 else "input"
        blocks.append(comparison_grid(methods, dataset, samples, truth=truth, title=title))
    return _save_sheets(blocks, output)


def save_tsne(runs: Sequence[Run], output: Path) -> list[Path]:
    """Shape codes of test images in the plane, coloured by the view, a map per run, as PNG and SVG."""
    return tsne.save_figure(tsne.draw_tsne(runs), output)


def save_interpolation(
    runs: Sequence[Run], output: Path, *, images: int = 3, indices: Sequence[int] = ()
) -> list[Path]:
    """Shapes between those of some test images, a strip per run, as a PNG.

    images: how many, chosen by `choose_samples`. indices: samples to use instead.
    """
    strips = [
        interpolate(
            run.method,
            run.dataset,
            choose_samples(run.dataset, images, indices),
            title=run.label if len(runs) > 1 else "input",
        )
        for run in runs
    ]
    return _save_sheets(strips, output)


def _save_sheets(sheets: Sequence[np.ndarray], output: Path) -> list[Path]:
    """Write pictures below each other as a PNG."""
    output.parent.mkdir(parents=True, exist_ok=True)
    path = output.with_suffix(".png")
    save_png(path, stack(sheets, gap=10))
    return [path]


def choose_samples(dataset: ViewDataset, count: int, indices: Sequence[int] = ()) -> Tensor:
    """The samples `indices`, int64, or else `count` of them, of different objects and views as far as possible.

    Raises ValueError if the data set has fewer.
    """
    if indices:
        return torch.tensor(indices)
    if not 1 <= count <= len(dataset):
        raise ValueError(f"the data set has {len(dataset)} images, {count} were asked for")
    return spread_samples(dataset.object_ids, dataset.view_ids, count)
