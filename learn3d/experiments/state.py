"""How far the runs of a table have come, from what is in their folders, whoever started them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from learn3d.config import TrainConfig, config_from_dict, differences, load_config
from learn3d.data.categories import synset_of
from learn3d.device import resolve_precision
from learn3d.experiments.plan import Options, Run, selected_rows
from learn3d.experiments.results import RESULT_FILE, read_result
from learn3d.experiments.tables import Table
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder


@dataclass(frozen=True)
class State:
    """How far a run has come."""

    stage: Literal["new", "unfinished", "trained", "done"]  # done: trained and measured
    step: int = 0


def read_state(run: Run) -> State:
    """How far the run in `run.folder` has come.

    Raises ValueError where the folder holds a run with other options (they are named), or one with more steps.
    """
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
    if read_results([run]):
        return State("done", step)
    return State("unfinished" if _is_damaged(run.folder / run_folder.LAST) else "trained", step)


def read_results(runs: Sequence[Run]) -> dict[Path, dict[str, Any]]:
    """The stored results of those runs that have one that is theirs, by folder."""
    found = {run.folder: read_result(path) for run in runs if (path := run.folder / RESULT_FILE).is_file()}
    return {run.folder: found[run.folder] for run in runs if run.folder in found and is_current(run, found[run.folder])}


def is_current(run: Run, result: dict[str, Any]) -> bool:
    """Whether a stored result is of these networks on this data."""
    wanted = (run.config.iterations, run.variant.checkpoint, str(run.config.data.resolve()))
    return (result["iterations"], result["checkpoint"], result["data"]) == wanted


def found_runs(table: Table, options: Options) -> list[Run]:
    """The runs of a table whose results are in the output folder, whatever their options; no preset is needed.

    Only the categories, methods and number of seeds among the options count. Raises ValueError where there is none.
    """
    runs = []
    for row in selected_rows(table, options.methods):
        pattern = f"*/{row.variant.name}-seed*/{RESULT_FILE}" if row.variant else ""
        for path in sorted((options.output / "runs").glob(pattern)) if pattern else []:
            category, number = path.parts[-3], path.parts[-2].rpartition("seed")[2]
            if category not in (options.categories or [category]) or not number.isdecimal():
                continue
            if options.seeds and int(number) >= options.seeds:
                continue
            try:
                synset_of(category)
            except ValueError as error:  # it goes into pages
                raise ValueError(f"{path.parent.parent} is no folder of a category: {error}") from None
            result = read_result(path)
            config = config_from_dict(result["config"], source=str(path))
            where = {"output": path.parent, "data": Path(result["data"])}  # a relative path was of another folder
            config = dataclasses.replace(config, iterations=result["iterations"], **where)
            runs.append(Run(row.variant, category, int(number), config))
    if not runs:
        raise ValueError(f"there is no result for the table {table.name} in {options.output / 'runs'}; train first")
    order = [*(options.categories or table.categories), *sorted({run.category for run in runs})]
    return sorted(runs, key=lambda run: order.index(run.category))


def _recorded(run: Run) -> tuple[TrainConfig | None, int, str | None]:
    """(configuration, steps taken, precision) of what is in the run's folder, from its last checkpoint, its result
    (where checkpoints were removed to save space) or its configuration; (None, 0, None) for no run."""
    for path in run_folder.checkpoints(run.folder):
        try:
            metadata = checkpoint.load_metadata(path)
        except checkpoint.DamagedError:  # the training says so, and goes on from the one before it
            continue
        return metadata.config, metadata.progress.step, metadata.conditions.precision
    if (path := run.folder / RESULT_FILE).is_file():
        values = read_result(path)
        precision = (values.get("conditions") or {}).get("precision")
        return config_from_dict(values["config"], source=str(path)), values["iterations"], precision
    if (run.folder / run_folder.CONFIG).is_file():
        return load_config(run.folder / run_folder.CONFIG), 0, None
    return None, 0, None


def _is_damaged(path: Path) -> bool:
    """Whether a checkpoint disagrees with its checksums: training then repeats the steps since the one before it."""
    try:
        checkpoint.load(path)
    except checkpoint.DamagedError:
        return True
    except ValueError:  # there is none: measuring says so
        pass
    return False
