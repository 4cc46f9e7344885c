"""Which runs a table needs, what each of them is, and how far it has come."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from learn3d.config import TrainConfig, config_from_dict, differences, load_config
from learn3d.data.layouts import LAYOUTS, Layout
from learn3d.data.readers.kato import synset_of
from learn3d.device import resolve_precision
from learn3d.experiments.stored import read_result
from learn3d.experiments.tables import Row, Table, Variant
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint, checkpoint_checks
from learn3d.runs import folder as run_folder

RESULT_FILE = "test.json"
LOG_FILE = "log.txt"
#: Settings that are steps of the schedule, as the presets have them, for any number of iterations.
_SCHEDULES = {"encoder_from_step": lambda n: n // 2 + 1, "decay_at_step": lambda n: n * 95 // 100}
_OWN_OPTIONS = ("data", "category", "output", "preset", "settings", "layout", "iterations", "batch_size", "seed")


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


@dataclass(frozen=True)
class State:
    """How far a run has come."""

    stage: Literal["new", "unfinished", "trained", "done"]  # done: trained and measured
    step: int = 0


def selected_rows(table: Table, methods: Sequence[str]) -> tuple[Row, ...]:
    """The rows whose label or variant is among `methods` (all for none), and the quoted ones.

    Raises ValueError naming a method that the table does not have.
    """
    known = {name: row for row in table.rows if row.variant for name in (row.label.lower(), row.variant.name.lower())}
    if unknown := [name for name in methods if name.lower() not in known]:
        raise ValueError(
            f"the table {table.name} has no method {', '.join(map(repr, unknown))}; it has "
            + ", ".join(row.variant.name for row in table.rows if row.variant)
        )
    chosen = [known[name.lower()] for name in methods] or list(table.rows)
    return tuple(row for row in table.rows if row.variant is None or row in chosen)


def plan_runs(table: Table, options: Options) -> list[Run]:
    """The runs that the rows of a table need, by category, then row, then seed.

    Raises ValueError for an unknown method or preset, for a layout without true voxels, and for options that do not fit
    (see `TrainConfig`).
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


def read_state(run: Run) -> State:
    """How far the run in `run.folder` has come, whoever started it.

    Raises ValueError where the folder holds a run with other options (they are named), or one with more steps.
    """
    result = run.folder / RESULT_FILE
    saved, step, precision = _recorded(run)
    if saved is None:
        return State("new")
    if precision == resolve_precision(run.config.precision, run.config.device):  # by name or by "auto", it is the same
        saved = dataclasses.replace(saved, precision=run.config.precision)
    changed = differences(run.config, saved)
    if run.variant.checkpoint == "best" and run.config.val_split != saved.val_split:
        changed.append(
            f"val_split: {saved.val_split!r} chose the run's best networks, {run.config.val_split!r} asked for"
        )
    if step > run.config.iterations:
        changed.append(f"iterations: {step} taken by the run, {run.config.iterations} asked for")
    if changed:
        raise ValueError(f"{run.folder} has a run with other options: " + "; ".join(changed))
    if step == 0:
        return State("new")
    if step < run.config.iterations:
        return State("unfinished", step)
    if result.is_file() and is_current(run, read_result(result)):
        return State("done", step)
    return State("unfinished" if _is_damaged(run.folder / run_folder.LAST) else "trained", step)


def read_results(runs: Sequence[Run]) -> dict[Path, dict[str, Any]]:
    """The stored results of those runs that have one that is theirs, by folder."""
    found = {run.folder: read_result(path) for run in runs if (path := run.folder / RESULT_FILE).is_file()}
    return {run.folder: found[run.folder] for run in runs if run.folder in found and is_current(run, found[run.folder])}


def found_runs(table: Table, options: Options) -> list[Run]:
    """The runs of a table whose results are in the output folder, whatever their options; no preset is needed.

    Only the categories, methods and number of seeds among the options count. Raises ValueError where there is none.
    """
    runs = []
    for row in selected_rows(table, options.methods):
        pattern = f"*/{row.variant.name}-seed*/{RESULT_FILE}" if row.variant else ""
        for path in sorted((options.output / "runs").glob(pattern)) if pattern else []:
            category, number = path.parts[-3], path.parts[-2].rpartition("seed")[2]
            if not number.isdecimal():
                continue
            seed = int(number)
            if category not in (options.categories or [category]) or seed >= (options.seeds or seed + 1):
                continue
            try:
                synset_of(category)
            except ValueError as error:  # it goes into pages
                raise ValueError(f"{path.parent.parent} is no folder of a category: {error}") from None
            result = read_result(path)
            config = config_from_dict(result["config"], source=str(path))
            where = {"output": path.parent, "data": Path(result["data"])}  # a relative path was of another folder
            config = dataclasses.replace(config, iterations=result["iterations"], **where)
            runs.append(Run(row.variant, category, seed, config))
    if not runs:
        raise ValueError(f"there is no result for the table {table.name} in {options.output / 'runs'}; train first")
    order = [*(options.categories or table.categories), *sorted({run.category for run in runs})]
    return sorted(runs, key=lambda run: order.index(run.category))


def is_current(run: Run, result: dict[str, Any]) -> bool:
    """Whether a stored result is of these networks on this data."""
    return (
        result.get("iterations") == run.config.iterations
        and result.get("checkpoint") == run.variant.checkpoint
        and result.get("data") == str(run.config.data.resolve())
    )


def command_line(config: TrainConfig, **placeholders: str) -> str:
    """The command that repeats a run, quoted for a POSIX shell; `placeholders` stand for options of these names."""
    preset = PRESETS[config.preset]
    values: dict[str, Any] = {"preset": config.preset}
    values |= {name: getattr(config, name) for name in ("data", "category", "output")}
    values |= {name: getattr(config, name) for name in ("iterations", "batch_size", "seed")}
    for field in dataclasses.fields(TrainConfig):
        if field.name not in _OWN_OPTIONS + ("device", "threads") or field.name == "layout":
            usual = getattr(preset, field.name, field.default)
            if getattr(config, field.name) != usual:
                values[field.name] = getattr(config, field.name)
    for field in dataclasses.fields(config.settings):
        value = getattr(config.settings, field.name)
        if value != getattr(preset.settings, field.name):
            values[field.name] = value
    words = ["learn3d", "train"]
    for name, value in (values | placeholders).items():
        option = name.replace("_", "-")
        if isinstance(value, bool):  # a flag: no word follows it
            words.append(f"--{option}" if value else f"--no-{option}")
            continue
        flat = [str(item) for item in value] if isinstance(value, tuple) else [str(value)]
        words += ["--" + option, *flat]
    return " ".join(word if word in placeholders.values() else shlex.quote(word) for word in words)


def _configure(
    table: Table, options: Options, variant: Variant, given: dict[str, Any], category: str, seed: int
) -> TrainConfig:
    preset = PRESETS[variant.preset]
    changes = dict(variant.changes) | given
    setting_names = {field.name for field in dataclasses.fields(preset.settings)}
    iterations = options.iterations or preset.iterations
    settings = {name: step_of(iterations) for name, step_of in _SCHEDULES.items() if name in setting_names}
    settings |= {name: value for name, value in changes.items() if name in setting_names}
    return TrainConfig(
        data=options.data,
        category=category,
        output=options.output / "runs" / category / f"{variant.name}-seed{seed}",
        preset=variant.preset,
        settings=dataclasses.replace(preset.settings, **settings),
        layout=options.layout or table.layout,
        iterations=options.iterations,
        batch_size=options.batch_size,
        seed=seed,
        device=options.device,
        threads=options.threads,
        **{name: value for name, value in changes.items() if name not in setting_names},
    )


def _changes_by_variant(variants: Sequence[Variant], table: Table, texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What "name=value" and "method:name=value" change in each variant; without a method, wherever the name exists."""
    labels = {row.label.lower(): row.variant.name for row in table.rows if row.variant}
    changes: dict[str, dict[str, Any]] = {variant.name: {} for variant in variants}
    options = {f.name: f.default for f in dataclasses.fields(TrainConfig) if f.name not in _OWN_OPTIONS}
    options |= {"augment": ()}
    for variant in variants:
        if variant.preset not in PRESETS:
            raise ValueError(
                f"the method {variant.name!r} of the table {table.name} needs the preset {variant.preset!r}, which "
                f"this version does not have; leave the method out (--methods). Presets: {', '.join(PRESETS)}"
            )
    for text in texts:
        target, separator, value = text.partition("=")
        method, colon, name = target.rpartition(":")
        name, method = name.strip().replace("-", "_"), labels.get(method.strip().lower(), method.strip())
        if not separator or not name:
            raise ValueError(f"a change is written as name=value or method:name=value, got {text!r}")
        if name in _OWN_OPTIONS:
            raise ValueError(
                f"{name} has an option of its own, or belongs to the table; it cannot be changed by {text!r}"
            )
        meant = [v for v in variants if not colon or v.name == method]
        if not meant:
            raise ValueError(f"{text!r} names the method {method!r}; there are {', '.join(v.name for v in variants)}")
        known = {v.name: dataclasses.asdict(PRESETS[v.preset].settings) | options for v in meant}
        able = [v for v in meant if name in known[v.name]]
        if not able:
            raise ValueError(f"{text!r}: there is no setting {name!r}; there are {', '.join(known[meant[0].name])}")
        for variant in able:
            changes[variant.name][name] = _parse(value, several=isinstance(known[variant.name][name], tuple))
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


def _is_damaged(path: Path) -> bool:
    """Whether a checkpoint disagrees with its checksums: training then repeats the steps since the one before it."""
    try:
        checkpoint.load(path)
    except checkpoint.DamagedError:
        return True
    except ValueError:  # there is none, or it is a later version's: measuring says so
        pass
    return False


def _recorded(run: Run) -> tuple[TrainConfig | None, int, str | None]:
    """(configuration, steps taken, precision) of what is in the run's folder, from its last checkpoint, its result
    (where checkpoints were removed to save space) or its configuration; (None, 0, None) for no run."""
    result = run.folder / RESULT_FILE
    for path in run_folder.checkpoints(run.folder):
        try:
            metadata = checkpoint.load_metadata(path)
        except checkpoint.DamagedError:  # the training says so, and goes on from the one before it
            continue
        checkpoint_checks.require(metadata, ("config", "step"), path)
        config = config_from_dict(metadata["config"], source=str(path))
        return config, metadata["step"], metadata.get("conditions", {}).get("precision")
    if result.is_file():
        values = read_result(result)
        config = config_from_dict(values["config"], source=str(result))
        return config, values["iterations"], values.get("conditions", {}).get("precision")
    if (run.folder / "config.json").is_file():
        return load_config(run.folder / "config.json"), 0, None
    return None, 0, None
