"""The paper's figures of opened runs as files: a function for each figure of `learn3d figures`."""

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
    """Save reconstructions of images as a PNG: a block per category, with a row per image and run.

    images, indices: the samples of each category, see `choose_samples`. truth: show the true voxels as well.
    """
    blocks, datasets = [], {id(run.dataset): run.dataset for run in runs}
    for dataset in datasets.values():
        samples = choose_samples(dataset, images, indices)
        methods = [(run.label, run.method) for run in runs if run.dataset is dataset]
        title = dataset.category if len(datasets) > 1 else "input"
        blocks.append(comparison_grid(methods, dataset, samples, truth=truth, title=title))
    return _save_stack(blocks, output)


def save_tsne(runs: Sequence[Run], output: Path) -> list[Path]:
    """Save shape codes in the plane, coloured by the view, as PNG and SVG: a map per run."""
    return tsne.save_figure(tsne.draw_tsne(runs), output)


def save_interpolation(
    runs: Sequence[Run], output: Path, *, images: int = 3, indices: Sequence[int] = ()
) -> list[Path]:
    """Save shapes between the reconstructions of some images as a PNG: a strip per run.

    images, indices: the samples, see `choose_samples`.
    """
    strips = []
    for run in runs:
        samples, title = choose_samples(run.dataset, images, indices), run.label if len(runs) > 1 else "input"
        strips.append(interpolate(run.method, run.dataset, samples, title=title))
    return _save_stack(strips, output)


def _save_stack(pictures: Sequence[np.ndarray], output: Path) -> list[Path]:
    output.parent.mkdir(parents=True, exist_ok=True)
    path = output.with_suffix(".png")
    save_png(path, stack(pictures, gap=10))
    return [path]


def choose_samples(dataset: ViewDataset, count: int, indices: Sequence[int] = ()) -> Tensor:
    """The samples `indices`, int64; without them `count` samples, of different objects and views if possible.

    Raises ValueError if the data set has fewer.
    """
    if indices:
        return torch.tensor(indices)
    if not 1 <= count <= len(dataset):
        raise ValueError(f"the data set has {len(dataset)} images, {count} were asked for")
    return spread_samples(dataset.object_ids, dataset.view_ids, count)
