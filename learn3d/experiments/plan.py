"""Which runs a table needs, and what each of them is."""

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
from learn3d.experiments.tables import Row, Table, Variant
from learn3d.presets import PRESETS

_SHOWN = ("preset", "data", "category", "output", "iterations", "batch_size", "seed")  # in every command line
_OWN_OPTIONS = (*_SHOWN, "settings", "layout")


@dataclass(frozen=True)
class Options:
    """What the user decides about the runs of a table."""

    data: Path  # folder of the data set
    output: Path  # folder of all runs and reports
    categories: tuple[str, ...] = ()  # (): the table's
    methods: tuple[str, ...] = ()  # labels of rows or names of variants; (): all
    iterations: int | None = None  # None: the preset's
    batch_size: int | None = None  # None: the preset's
    seeds: int | None = None  # seeds 0 .. seeds - 1; None: the table's
    layout: Layout | None = None  # None: the table's
    device: Literal["cpu", "cuda"] = "cpu"
    threads: int | None = None  # of each run
    changes: tuple[str, ...] = ()  # "name=value" or "method:name=value": settings and options of the training


@dataclass(frozen=True)
class Run:
    """One training run and its measurement. Its folder is its identity: any table that needs it finds it there."""

    variant: Variant
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


def selected_rows(table: Table, methods: Sequence[str]) -> tuple[Row, ...]:
    """The rows whose label or variant is among `methods` (all for none), and the quoted ones.

    Raises ValueError naming a method that the table does not have.
    """
    known = {name: row for row in table.rows if row.variant for name in (row.label.lower(), row.variant.name.lower())}
    if unknown := [name for name in methods if name.lower() not in known]:
        raise ValueError(
            f"the table {table.name} has no method {', '.join(map(repr, unknown))}; it has "
            + ", ".join(variant.name for variant in table.variants)
        )
    chosen = [known[name.lower()] for name in methods] or list(table.rows)
    return tuple(row for row in table.rows if row.variant is None or row in chosen)


def plan_runs(table: Table, options: Options) -> list[Run]:
    """The runs that the rows of a table need, by category, then row, then seed.

    Raises ValueError for an unknown method, for a layout without true voxels, and for options that do not fit (see
    `TrainConfig`).
    """
    layout = options.layout or table.layout
    if layout in LAYOUTS and not LAYOUTS[layout].voxels:
        raise ValueError(f"the layout {layout!r} has no true voxels, so that no run of the table could be measured")
    variants = [row.variant for row in selected_rows(table, options.methods) if row.variant]
    changes = _changes_by_variant(variants, table, options.changes)
    seeds = table.seeds if options.seeds is None else options.seeds
    if seeds < 1:
        raise ValueError(f"seeds must be a number of seeds, at least 1, got {seeds}")
    categories = options.categories or table.categories
    if len(set(categories)) != len(categories):
        raise ValueError(f"categories must be different ones, got {', '.join(categories)}")
    return [
        Run(variant, category, seed, _configure(table, options, variant, changes[variant.name], category, seed))
        for category in categories
        for variant in variants
        for seed in range(seeds)
    ]


def command_line(config: TrainConfig, **placeholders: str) -> str:
    """The command that repeats a run, quoted for a POSIX shell; `placeholders` stand for options of these names."""
    where = {name: getattr(config, name) for name in ("data", "category", "output", "preset")}
    usual, values = (_flat(c) for c in (TrainConfig(**where), config))
    names = [n for n in values if n not in (*_SHOWN, "device", "threads") and values[n] != usual[n]]
    words = ["learn3d", "train"]
    for name in (*_SHOWN, *names):
        option, value = name.replace("_", "-"), values[name]
        if name in placeholders:
            words += [f"--{option}", placeholders[name]]
        elif isinstance(value, bool):  # a flag: no word follows it
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            items = value if isinstance(value, tuple) else (value,)
            words += [f"--{option}", *(shlex.quote(str(item)) for item in items)]
    return " ".join(words)


def _flat(config: TrainConfig) -> dict[str, Any]:
    """Options by name, the method's settings among them."""
    values = {field.name: getattr(config, field.name) for field in dataclasses.fields(config)}
    return values | dataclasses.asdict(values.pop("settings"))


def _configure(
    table: Table, options: Options, variant: Variant, given: dict[str, Any], category: str, seed: int
) -> TrainConfig:
    preset = PRESETS[variant.preset]
    changes = dict(variant.changes) | given
    setting_names = {field.name for field in dataclasses.fields(preset.settings)}
    parts = variant.smaller_batches
    whole = PRESETS[variant.whole or variant.preset]
    iterations = (options.iterations or whole.iterations) * parts
    batch_size = options.batch_size or whole.batch_size
    if batch_size % parts:
        raise ValueError(f"{variant.name} divides batches by {parts}: batch_size must be a multiple, got {batch_size}")
    if "warmup_steps" in changes:  # no more than a preset's own
        changes["warmup_steps"] = min(changes["warmup_steps"], iterations // 10)
    settings = {name: value for name, value in changes.items() if name in setting_names}
    return TrainConfig(
        data=options.data,
        category=category,
        output=options.output / "runs" / category / f"{variant.name}-seed{seed}",
        preset=variant.preset,
        settings=dataclasses.replace(preset.settings.for_iterations(iterations), **settings),
        layout=options.layout or table.layout,
        iterations=iterations,
        batch_size=batch_size // parts,
        seed=seed,
        device=options.device,
        threads=options.threads,
        **{name: value for name, value in changes.items() if name not in setting_names},
    )


def _changes_by_variant(variants: Sequence[Variant], table: Table, texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What "name=value" and "method:name=value" change in each variant; without a method, wherever the name exists."""
    labels = {row.label.lower(): row.variant.name for row in table.rows if row.variant}
    options = {field.name: field.default for field in dataclasses.fields(TrainConfig)} | {"augment": ()}
    known = {v.name: dataclasses.asdict(PRESETS[v.preset].settings) | options for v in variants}
    changes: dict[str, dict[str, Any]] = {name: {} for name in known}
    for text in texts:
        target, separator, value = text.partition("=")
        method, _, name = target.rpartition(":")
        name, method = name.strip().replace("-", "_"), labels.get(method.strip().lower(), method.strip())
        if not separator or not name:
            raise ValueError(f"a change is written as name=value or method:name=value, got {text!r}")
        if name in _OWN_OPTIONS:
            raise ValueError(f"{name} has an option of its own, or belongs to the table; {text!r} cannot change it")
        if method and method not in known:
            raise ValueError(f"{text!r} names the method {method!r}; there are {', '.join(known)}")
        meant = [method] if method else list(known)
        able = [variant for variant in meant if name in known[variant]]
        if not able:
            raise ValueError(f"{text!r}: there is no setting {name!r}; there are {', '.join(known[meant[0]])}")
        for variant in able:
            changes[variant][name] = _parse(value, several=isinstance(known[variant][name], tuple))
    return changes


def _parse(text: str, several: bool = False) -> Any:
    """A value as JSON has it (0.5, true, null, [1, 2]), else the text itself; "a,b" where several values are wanted."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        value = text
    if several and isinstance(value, str):
        return tuple(_parse(part) for part in value.split(",") if part)
    return tuple(value) if isinstance(value, list) else value
