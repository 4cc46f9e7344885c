"""Plans the training runs of a table: their names, folders and options."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from learn3d.config import TrainConfig, all_options
from learn3d.data.layouts import LAYOUTS, Layout
from learn3d.presets import PRESETS, USUAL_OPTIONS, configure
from learn3d.settings import Count, Step, checked, split_names
from learn3d.studio.tables.tables import BATCH_DIVISOR, TABLES, VARIANTS, Row
from learn3d.tasks import ONE_WORKER, Workers
from learn3d.terminal import unknown_name

# Options that --set cannot change.
_FIXED = (*USUAL_OPTIONS, "layout", "device", "threads", "poses")


@checked
class Request:
    """The table that the user asks for, with options."""

    table: str
    """Name of the table, see --list."""
    data: Path
    """Folder of the data set."""
    output: Path
    """Folder of runs and reports; all tables can share one."""
    category: str = ""
    """Categories, separated by commas, each trained by itself. If not given: the table's."""
    methods: tuple[str, ...] = ()
    """Methods of the table: labels of rows, or names of variants. If not given: all."""
    iterations: Step | None = None
    """Training steps; methods with a quarter of the batch, such as Plus, take four times as many.
    If not given: the preset's."""
    batch_size: Count | None = None
    """Images per step; Plus and others take a quarter of it. If not given: the preset's."""
    seeds: Count | None = None
    """Number of seeds, 0 .. seeds - 1. If not given: the table's."""
    layout: Layout | None = None
    """Layout of the data set. If not given: the table's."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device on which the networks run."""
    threads: Count | None = None
    """CPU threads of each run. If not given: cores, or OMP_NUM_THREADS, divided by --jobs; 1 with
    --cluster."""
    set: tuple[str, ...] = ()
    """Settings and training options to change: NAME=VALUE for all methods that have them,
    METHOD:NAME=VALUE for one. If not given: none."""
    workers: Workers = ONE_WORKER
    report_only: bool = False
    """Train nothing: report the runs that are complete."""

    def __post_init__(self) -> None:
        if self.table not in TABLES:
            raise ValueError(f"{unknown_name('table', self.table, TABLES)} (see --list)")


@dataclass(frozen=True)
class PlannedRun:
    """A training of a table, in the folder OUTPUT/runs/<category>/<variant>-seed<k>."""

    variant: str  # name in `VARIANTS`
    config: TrainConfig

    @property
    def name(self) -> str:
        """<category>/<variant>-seed<k>."""
        return f"{self.config.category}/{self.variant}-seed{self.config.seed}"


def select_rows(request: Request) -> dict[str, Row]:
    """The rows that the request asks for by label or variant, by label; without methods all.

    Quoted rows are always included. Raises ValueError for a method that the table does not have.
    """
    rows = TABLES[request.table].rows
    names = {label.lower(): row.variant for label, row in rows.items()} | {
        r.variant: r.variant for r in rows.values()
    }
    asked = [method.lower() for method in request.methods] or list(names)
    if unknown := [method for method in asked if method not in names]:
        raise ValueError(
            unknown_name("method of the table", unknown[0], filter(None, names.values()))
        )
    chosen = {names[method] for method in asked}
    return {
        label: row for label, row in rows.items() if row.variant is None or row.variant in chosen
    }


def plan_runs(request: Request) -> list[PlannedRun]:
    """The training runs of a request, by category, then row, then seed.

    Tables that need the same run share its folder.

    Raises ValueError for an unknown method, for a layout without true voxels, and for options
    that do not fit (see `TrainConfig`).
    """
    table = TABLES[request.table]
    layout = request.layout or table.layout
    if not LAYOUTS[layout].voxels:
        raise ValueError(
            f"the layout {layout!r} has no true voxels, so that no run of the table could be measured"
        )
    variants = [row.variant for row in select_rows(request).values() if row.variant]
    changes = _parse_changes(variants, request.set)
    return [
        PlannedRun(name, _configure(request, name, changes[name], layout, category, seed))
        for category in dict.fromkeys(split_names(request.category) or table.categories)
        for name in variants
        for seed in range(request.seeds or table.seeds)
    ]


def _configure(
    request: Request, name: str, given: dict[str, Any], layout: Layout, category: str, seed: int
) -> TrainConfig:
    variant = VARIANTS[name]
    preset = PRESETS[variant.preset]
    length_of = PRESETS[variant.small_batches_of or variant.preset]
    changes = dict(variant.changes) | given
    divisor = BATCH_DIVISOR if variant.small_batches_of else 1
    iterations = (request.iterations or length_of.iterations) * divisor
    batch_size = request.batch_size or length_of.batch_size
    if batch_size % divisor:
        raise ValueError(
            f"{name} divides batches by {divisor}: batch_size must be a multiple, got {batch_size}"
        )
    return configure(
        variant.preset,
        data=request.data,
        category=category,
        output=request.output / "runs" / category / f"{name}-seed{seed}",
        poses=request.output / "poses" / f"{category}-seed{seed}.npz"
        if variant.estimates_poses
        else None,
        settings=preset.settings.for_iterations(iterations),
        layout=layout,
        iterations=iterations,
        batch_size=batch_size // divisor * variant.batch_factor,
        seed=seed,
        device=request.device,
        threads=request.threads,
        **changes,
    )


def _parse_changes(variants: Sequence[str], texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The changes NAME=VALUE and VARIANT:NAME=VALUE, by variant."""
    known = {name: all_options(PRESETS[VARIANTS[name].preset]) for name in variants}
    changes: dict[str, dict[str, Any]] = {variant: {} for variant in variants}
    for text in texts:
        target, separator, value = text.partition("=")
        variant, _, name = target.rpartition(":")
        name = name.replace("-", "_")
        meant = [
            v for v in variants if variant in ("", v) and name in known[v] and name not in _FIXED
        ]
        if not meant or not separator:
            raise ValueError(
                f"--set {text}: give NAME=VALUE or METHOD:NAME=VALUE, with a method of {', '.join(variants)}, and an "
                "option of `learn3d train` that neither the table nor another option decides"
            )
        for v in meant:
            changes[v][name] = _parse_value(value, isinstance(known[v][name], tuple))
    return changes


def _parse_value(text: str, is_list: bool = False) -> Any:
    """A value as in JSON (0.5, true, null), else the text itself; a list is written as "a,b"."""
    if is_list:
        return tuple(map(_parse_value, filter(None, text.strip("[]").split(","))))
    try:
        return json.loads(text)
    except ValueError:
        return text
