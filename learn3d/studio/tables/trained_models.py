"""Opens runs for figures and pages: the trained method, a data set and a label of each."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from learn3d.config import TrainConfig
from learn3d.data.dataset import ViewDataset
from learn3d.methods.method import Method
from learn3d.runs import checkpoint
from learn3d.runs.checkpoint import Metadata
from learn3d.terminal import note


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A trained method and the data on which figures show it.

    Runs on the same data share one `dataset`.
    """

    label: str
    method: Method  # in evaluation mode
    dataset: ViewDataset
    metadata: Metadata | None = None


def open_runs(
    paths: Sequence[Path],
    *,
    labels: Sequence[str] = (),
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    which: Literal["last", "best"] = "last",
) -> list[TrainedModel]:
    """Open run folders (checkpoint `which`) or checkpoint files, each with a split of its data.

    `data` and `category` default to those of the training, `labels` to `name_runs`. Raises
    ValueError without runs, for a wrong number of labels, and if a checkpoint or data set cannot
    be read.
    """
    if not paths:
        raise ValueError("give at least one run folder or checkpoint to draw")
    configs = []
    runs = []
    datasets = {}
    for path in paths:
        note(f"opening {path}")
        method, config, metadata = checkpoint.load_method(path, which)
        configs.append(
            dataclasses.replace(
                config, data=data or config.data, category=category or config.category
            )
        )
        key = (
            config.layout,
            configs[-1].data.resolve(),
            configs[-1].category,
            method.image_size,
            config.view_bins,
        )
        key += (config.poses, config.views_per_object) if data is None else ()
        if key not in datasets:
            datasets[key] = checkpoint.load_data(config, split, data=data, category=category)
        runs.append((method, datasets[key], metadata))
    return [
        TrainedModel(name, *run)
        for name, run in zip(name_runs(configs, paths, labels), runs, strict=True)
    ]


def name_runs(
    configs: Sequence[TrainConfig], paths: Sequence[Path], labels: Sequence[str] = ()
) -> list[str]:
    """Names of runs in a figure: `labels`, else presets' names, with the category if several.

    Runs of the same preset and category get the names of their folders. Raises ValueError for a
    wrong number of labels.
    """
    if labels:
        if len(labels) != len(paths):
            raise ValueError(
                f"there are {len(paths)} runs but {len(labels)} labels; give one label per run, or none"
            )
        return list(labels)
    several = len({config.category for config in configs}) > 1
    names = [f"{c.category}: " * several + c.label for c in configs]
    folders = [
        f"{p.parent.name}/{p.stem}" if p.is_file() else p.name
        for p in map(Path.resolve, map(Path, paths))
    ]
    return [
        folder if names.count(name) > 1 else name
        for name, folder in zip(names, folders, strict=True)
    ]
