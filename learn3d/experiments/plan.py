"""The training runs that a table needs: their names, folders and options."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from learn3d.config import TrainConfig
from learn3d.data.layouts import LAYOUTS, Layout
from learn3d.experiments.tables import TABLES, VARIANTS, Table, Variant
from learn3d.presets import PRESETS
from learn3d.settings import Rare, split_names
from learn3d.terminal import unknown_name

_FIRST = ("preset", "data", "category", "output", "iterations", "batch_size", "seed")  # in every command line
_NOT_CHANGEABLE = (*_FIRST, "settings", "layout")  # by --set: the request or the table decides them


@dataclass(frozen=True)
class Request:
    """The table that is asked for, and the choices of the user."""

    table: str
    """Name of the table, see --list."""
    data: Path
    """Folder of the data set."""
    output: Path
    """Folder of runs and reports; all tables can share one."""
    category: str = ""
    """Categories, separated by commas, each trained by itself (default: the table's)."""
    methods: tuple[str, ...] = ()
    """Methods of the table: labels of rows, or names of variants (default: all)."""
    iterations: int | None = None
    """Training steps of every run (default: the preset's)."""
    batch_size: int | None = None
    """Images per training step (default: the preset's)."""
    seeds: int | None = None
    """Number of seeds, 0 .. seeds - 1 (default: the table's)."""
    layout: Rare[Layout | None] = None
    """Layout of the data set (default: the table's)."""
    device: Rare[Literal["cpu", "cuda"]] = "cpu"
    """Device on which the networks run."""
    threads: Rare[int | None] = None
    """CPU threads of each run (default: cores, or OMP_NUM_THREADS, divided by --jobs)."""
    set: tuple[str, ...] = ()
    """Settings and training options to change, as NAME=VALUE in all methods that have them, or as METHOD:NAME=VALUE in
    one (default: none)."""
    jobs: int = 1
    """Runs at a time, each in a process of its own with its share of the cores."""
    cluster: Rare[str | None] = None
    """Address or scheduler file of the Dask cluster that runs them, see docs/scale.md (default: they run here)."""
    overwrite: bool = False
    """Start runs anew that are there with other options."""
    report_only: bool = False
    """Train nothing: report the runs that are complete."""

    @property
    def categories(self) -> tuple[str, ...]:
        """The names in `category`."""
        return split_names(self.category)

    def __post_init__(self) -> None:
        if self.table not in TABLES:
            raise ValueError(f"{unknown_name('table', self.table, TABLES)} (see --list)")
        if self.jobs < 1:
            raise ValueError(f"jobs must be a number of processes, at least 1, got {self.jobs}")
        if self.seeds is not None and self.seeds < 1:
            raise ValueError(f"seeds must be a number of seeds, at least 1, got {self.seeds}")
        if len(set(self.categories)) != len(self.categories):
            raise ValueError(f"categories must be different ones, got {', '.join(self.categories)}")
        if self.report_only and self.overwrite:
            raise ValueError("--report-only trains nothing and --overwrite trains anew; give one of them")


@dataclass(frozen=True)
class PlannedRun:
    """A training run and its test. The folder identifies it: every table that needs the run finds it there."""

    variant: str
    category: str
    seed: int
    config: TrainConfig

    @property
    def folder(self) -> Path:
        return self.config.output

    @property
    def name(self) -> str:
        """<category>/<variant>-seed<k>."""
        return f"{self.category}/{self.folder.name}"

    @property
    def checkpoint(self) -> Literal["last", "best"]:
        """The checkpoint that is tested."""
        return VARIANTS[self.variant].checkpoint


def selected_rows(table: Table, name: str, methods: Sequence[str]) -> dict[str, str | None]:
    """The rows of a table, label -> variant, whose label or variant is among `methods` (all for none), and quoted ones.

    Raises ValueError naming a method that the table does not have.
    """
    variants = [variant for variant in table.rows.values() if variant]
    labels = {label.lower(): variant for label, variant in table.rows.items()} | {v: v for v in variants}
    if unknown := [method for method in methods if not labels.get(method.lower())]:
        unknown_names = ", ".join(map(repr, unknown))
        raise ValueError(f"the table {name} has no method {unknown_names}; it has {', '.join(variants)}")
    chosen = [labels[method.lower()] for method in methods] or variants
    return {label: variant for label, variant in table.rows.items() if variant is None or variant in chosen}


def plan_runs(request: Request) -> list[PlannedRun]:
    """The runs of a request, by category, then row, then seed.

    Raises ValueError for an unknown method, for a layout without true voxels, and for options that do not fit (see
    `TrainConfig`).
    """
    table = TABLES[request.table]
    layout = request.layout or table.layout
    if layout in LAYOUTS and not LAYOUTS[layout].voxels:
        raise ValueError(f"the layout {layout!r} has no true voxels, so that no run of the table could be measured")
    variants = [variant for variant in selected_rows(table, request.table, request.methods).values() if variant]
    changes = _parse_changes(variants, table, request.set)
    return [
        PlannedRun(name, category, seed, _configure(request, layout, name, changes[name], category, seed))
        for category in request.categories or table.categories
        for name in variants
        for seed in range(request.seeds or table.seeds)
    ]


def _configure(
    request: Request, layout: Layout, name: str, given: dict[str, Any], category: str, seed: int
) -> TrainConfig:
    variant: Variant = VARIANTS[name]
    preset, length_of = PRESETS[variant.preset], PRESETS[variant.length_of or variant.preset]
    changes = dict(variant.changes) | given
    divisor = variant.batch_divisor
    iterations = (request.iterations or length_of.iterations) * divisor
    batch_size = request.batch_size or length_of.batch_size
    if batch_size % divisor:
        raise ValueError(f"{name} divides batches by {divisor}: batch_size must be a multiple, got {batch_size}")
    if "warmup_steps" in changes:  # as for presets
        changes["warmup_steps"] = min(changes["warmup_steps"], iterations // 10)
    setting_names = {field.name for field in dataclasses.fields(preset.settings)}
    settings = {key: value for key, value in changes.items() if key in setting_names}
    return TrainConfig(
        data=request.data,
        category=category,
        output=request.output / "runs" / category / f"{name}-seed{seed}",
        preset=variant.preset,
        settings=dataclasses.replace(preset.settings.for_iterations(iterations), **settings),
        layout=layout,
        iterations=iterations,
        batch_size=batch_size // divisor,
        seed=seed,
        device=request.device,
        threads=request.threads,
        **{key: value for key, value in changes.items() if key not in setting_names},
    )


def _parse_changes(variants: Sequence[str], table: Table, texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The changes "name=value" and "method:name=value" by variant; without a method, of all variants with that name."""
    labels = {label.lower(): variant for label, variant in table.rows.items()}
    options = {field.name: field.default for field in dataclasses.fields(TrainConfig)} | {"augment": ()}
    known = {v: dataclasses.asdict(PRESETS[VARIANTS[v].preset].settings) | options for v in variants}
    changes: dict[str, dict[str, Any]] = {variant: {} for variant in known}
    for text in texts:
        target, separator, value = text.partition("=")
        method, _, name = target.rpartition(":")
        name, method = name.strip().replace("-", "_"), labels.get(method.strip().lower(), method.strip())
        if not separator or not name:
            raise ValueError(f"a change is written as name=value or method:name=value, got {text!r}")
        if name in _NOT_CHANGEABLE:
            raise ValueError(f"{name} has an option of its own, or belongs to the table; {text!r} cannot change it")
        if method and method not in known:
            raise ValueError(f"{text!r} names the method {method!r}; there are {', '.join(known)}")
        meant = [method] if method else list(known)
        with_name = [variant for variant in meant if name in known[variant]]
        if not with_name:
            raise ValueError(f"{text!r}: there is no setting {name!r}; there are {', '.join(known[meant[0]])}")
        for variant in with_name:
            changes[variant][name] = _parse_value(value, is_tuple=isinstance(known[variant][name], tuple))
    return changes


def _parse_value(text: str, is_tuple: bool = False) -> Any:
    """A value as in JSON (0.5, true, null, [1, 2]), else the text itself; for a tuple also "a,b"."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = text
    if is_tuple and isinstance(value, str):
        return tuple(_parse_value(part) for part in value.split(",") if part)
    return tuple(value) if isinstance(value, list) else value


def command_line(config: TrainConfig, **placeholders: str) -> str:
    """The command that repeats a run, quoted for a POSIX shell; `placeholders` replace the values of these options."""
    values, usual = _flatten(config), _flatten(TrainConfig(config.data, config.category, config.output, config.preset))
    names = [n for n in values if n not in (*_FIRST, "device", "threads") and values[n] != usual[n]]
    words = ["learn3d", "train"]
    for name in (*_FIRST, *names):
        option, value = name.replace("_", "-"), values[name]
        if name in placeholders:
            words += [f"--{option}", placeholders[name]]
        elif isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            items = value if isinstance(value, tuple) else (value,)
            words += [f"--{option}", *(shlex.quote(str(item)) for item in items)]
    return " ".join(words)


def _flatten(config: TrainConfig) -> dict[str, Any]:
    """Options by name, the method's settings among them."""
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return values | dataclasses.asdict(values.pop("settings"))
