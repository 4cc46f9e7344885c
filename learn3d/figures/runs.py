"""Saved checkpoints, opened for figures: method, data and a name for each."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from learn3d.config import TrainConfig, differences
from learn3d.data.dataset import ViewDataset
from learn3d.methods import Method
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint


@dataclass(frozen=True, eq=False)
class Run:
    """A trained method with the data that figures show it on. Runs on the same data share one `dataset`."""

    label: str  # what figures call it; different for the runs of one category
    method: Method  # in evaluation mode
    dataset: ViewDataset


def open_runs(
    paths: Sequence[Path],
    *,
    labels: Sequence[str] = (),
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    which: Literal["last", "best"] = "last",
    device: str = "cpu",
    report_progress: Callable[[str], None] = lambda text: None,
) -> list[Run]:
    """Open run folders or checkpoint files, with one split of the data.

    `data` and `category` default to those each run was trained with, `labels` to the names of their presets. Raises
    ValueError without runs, for a wrong number of labels, and where a checkpoint or data set cannot be read.
    """
    if not paths:
        raise ValueError("give at least one run folder or checkpoint to draw")
    loaded, datasets = [], {}
    for path in paths:
        report_progress(f"opening {path}")
        method, config, _ = checkpoint.load_method(checkpoint.find(path, which), device=device)
        config = dataclasses.replace(config, data=data or config.data, category=category or config.category)
        key = (config.layout, config.data.resolve(), config.category, method.image_size, config.view_bins)
        if key not in datasets:
            datasets[key] = checkpoint.load_data(config, split)
        loaded.append((method, config, datasets[key]))
    names = name_runs([config for _, config, _ in loaded], paths, labels)
    return [Run(name, method, dataset) for name, (method, _, dataset) in zip(names, loaded, strict=True)]


def name_runs(
    configs: Sequence[TrainConfig], paths: Sequence[Path], labels: Sequence[str] = (), *, seeds_apart: bool = True
) -> list[str]:
    """What to call each run in a figure: the given label, else the preset's.

    Runs of one preset and category that differ in more than their seed are called after their folders. With
    `seeds_apart` the seed is said where runs differ by it alone; without, such runs have one name.
    """
    if labels:
        if len(labels) != len(paths):
            raise ValueError(f"there are {len(paths)} runs but {len(labels)} labels; give one label per run, or none")
        return list(labels)
    names = [PRESETS[config.preset].label for config in configs]
    for i, config in enumerate(configs):
        alike = [c for c in configs if (c.preset, c.category) == (config.preset, config.category)]
        if any(differences(dataclasses.replace(config, seed=c.seed), c) for c in alike):
            names[i] = _folder_name(paths[i])
        elif seeds_apart and len(alike) > 1:
            same_seed = sum(c.seed == config.seed for c in alike) > 1
            names[i] = _folder_name(paths[i]) if same_seed else f"{names[i]}, seed {config.seed}"
    return names


def title_of(run: Run, runs: Sequence[Run]) -> str:
    """The run's label, with its category where several are shown."""
    several = len({r.dataset.category for r in runs}) > 1
    return f"{run.dataset.category}: {run.label}" if several else run.label


def by_dataset(runs: Sequence[Run]) -> list[list[Run]]:
    """The runs in groups that share a data set, in the order of their first appearance."""
    groups: dict[int, list[Run]] = {}
    for run in runs:
        groups.setdefault(id(run.dataset), []).append(run)
    return list(groups.values())


@torch.no_grad()
def encode(method: Method, dataset: ViewDataset, samples: Tensor, *, batch_size: int = 256) -> Tensor:
    """Shape codes float32 [n, C] of the images `samples` int64 [n], on the CPU."""
    parts = [method.encode(dataset.batch(part).images).float().cpu() for part in samples.split(batch_size)]
    return torch.cat(parts)


def _folder_name(path: Path) -> str:
    path = Path(path).resolve()
    return f"{path.parent.name}/{path.stem}" if path.is_file() else path.name
