"""`learn3d experiment`: plan a table's runs, train and test missing ones, write the report."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from pydantic import TypeAdapter

from learn3d.config import TrainConfig, differences
from learn3d.data.layouts import Layout, load_dataset
from learn3d.data.poses import wrap_deg
from learn3d.device import resolve_precision
from learn3d.files import limits, writing
from learn3d.files.reading import read_bytes
from learn3d.presets import load_config
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.runs.baselines import measure_baselines
from learn3d.runs.measurement import Baseline, Result, evaluate_runs, read_curve
from learn3d.studio.poses.comparison import compare
from learn3d.studio.poses.estimate import NEAR_DEG
from learn3d.studio.poses.options import PoseOptions
from learn3d.studio.poses.views import CameraOptions, estimate_views, load_views
from learn3d.studio.tables.comparison import make_report, read_pose_errors
from learn3d.studio.tables.plan import PlannedRun, Request, plan_runs
from learn3d.studio.tables.tables import TABLES, VARIANTS
from learn3d.tasks import Task, run_tasks
from learn3d.terminal import INTERRUPTED, align, note, say
from learn3d.training import train

LOG_FILE, RESULT_FILE = "log.txt", "test.json"  # files in a run's folder


def estimate_poses(config: TrainConfig) -> None:
    """Write the estimated poses that a run needs, unless they exist, and their errors as JSON.

    The estimate has the run's seed. It is turned into the frame of the data by the angle that
    fits the training and validation images best.
    """
    if config.poses.is_file():
        return
    datasets = load_views(config.layout, config.data, config.category, config.views_per_object)
    views = estimate_views(datasets, CameraOptions(), PoseOptions(seed=config.seed))
    comparison = compare(views)
    note(comparison.text())
    config.poses.parent.mkdir(parents=True, exist_ok=True)
    confidence = {"confidence": float(views.table.confidence.mean())}
    writing.write_json(
        config.poses.with_suffix(".json"), dataclasses.asdict(comparison) | confidence
    )
    views.table.turned(comparison.offset_deg).write(config.poses)


def _measure_updated_poses(config: TrainConfig) -> None:
    """Add the share of azimuths that the training ended with right to 30 degrees to the errors."""
    weights = checkpoint.load(checkpoint.find(config.output, "last"))[0]["poses.weights"]
    load = functools.partial(load_dataset, config.layout, config.data, config.category, "train")
    known = load(views_per_object=config.views_per_object)
    estimated = load(views_per_object=config.views_per_object, poses=config.poses)
    azimuths = estimated.candidates.poses.azimuth_deg.view(weights.shape)
    best = azimuths.gather(1, weights.argmax(1, keepdim=True))[:, 0]
    right = wrap_deg(best - torch.as_tensor(known.poses.azimuth_deg)).abs() <= NEAR_DEG
    errors = read_pose_errors(config.poses) | {"updated_accuracy": float(right.double().mean())}
    writing.write_json(config.poses.with_suffix(".json"), errors)


def train_and_test(run: PlannedRun) -> bool:
    """Estimate poses if needed, train, measure, write test.json; False if a signal stopped it.

    An existing run continues; `train` checks that it has the same options and data. Raises as
    `train` and `evaluate_runs` do.
    """
    config = run.config
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if config.poses is not None:
        estimate_poses(config)
    resume = run_folder.is_run(config.output)
    if not train(
        config, resume=resume, overwrite=not resume
    ).finished:  # the folder exists: log.txt is in it
        return False
    if config.poses is not None:
        _measure_updated_poses(config)
    which = VARIANTS[run.variant].checkpoint
    measure = functools.partial(
        evaluate_runs, [config.output], data=config.data, device=config.device
    )
    (result,) = measure(which=which)
    result.curve = read_curve(config.output)
    other = checkpoint.find(config.output, "best" if which == "last" else "last")
    if other.is_file() and checkpoint.load_metadata(other).progress.step != result.step:
        (result.other,) = measure(which=other.stem)
    writing.write_json(config.output / RESULT_FILE, result.model_dump())
    print(f"tested: voxel IoU {result.voxel_iou:.4f} (kato18)", flush=True)
    return True


def run_experiment(request: Request, *, work: Callable[[PlannedRun], bool] = train_and_test) -> int:
    """Train and test the missing runs of a table and write its report.

    Returns the exit status: 0, 1 if a run failed, 130 if a signal stopped it. The report of the
    results so far is written in any case. work: trains and tests a run, and returns False if a
    signal stopped it. Raises ValueError for an unknown method or option, for runs with other
    options in the output folder, and for damaged files.
    """
    threads = request.threads or request.workers.threads
    runs = plan_runs(dataclasses.replace(request, threads=threads))
    if conflicts := [text for run in runs if (text := find_conflict(run.config))]:
        advice = "ask for the same options, choose another --output, or remove these folders"
        raise ValueError("\n  ".join([*conflicts, advice]))
    results = read_results(runs)
    failed = []
    if not request.report_only:
        logs = request.output / "runs/*/*" / LOG_FILE
        note(f"{request.table}: {len(runs)} runs, {len(results)} of them done; logs: {logs}")
        missing = [run for run in runs if run.name not in results]
        tasks = [Task(run.name, work, (run,), run.config.output / LOG_FILE) for run in missing]
        failed = run_tasks(tasks, request.workers)
        results = read_results(runs)
    baselines = []
    if TABLES[request.table].measure == "voxel_iou":
        first = runs[0].config
        for category in dict.fromkeys(run.config.category for run in runs):
            baselines += find_baselines(request.output, first.layout, first.data, category)
    tables, text = make_report(request, runs, results, baselines)
    path = request.output / f"{request.table}.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    writing.write_bytes(path, text.encode())
    writing.write_json(path.with_suffix(".json"), tables)
    say(align(tables["main"]))
    note(f"report: {path}; its tables for other programs: {path.with_suffix('.json').name}")
    if failed:
        note(
            f"{len(failed)} of {len(runs)} runs failed ({', '.join(failed)}); the same command tries them again"
        )
        return 1
    if len(results) < len(runs) and not request.report_only:
        note("stopped; the same command goes on")
        return INTERRUPTED
    return 0


def read_result(path: Path) -> Result:
    """Read a test.json. Raises ValueError naming the file if it is damaged or no result."""
    try:
        return Result.model_validate_json(
            read_bytes(path, limits.JSON_BYTES, "the measurement of a run as JSON")
        )
    except ValueError as error:
        reason = " ".join(str(error).splitlines()[1:3])
        raise ValueError(
            f"{path} is no measurement of a run ({reason}); remove it, and it is made again"
        ) from None


def read_results(runs: Sequence[PlannedRun]) -> dict[str, Result]:
    """The stored results of these runs, by name.

    Those of other data or another number of iterations are left out.
    """
    results = {}
    for run in runs:
        config = run.config
        if (path := config.output / RESULT_FILE).is_file():
            result = read_result(path)
            if (result.iterations, result.data) == (config.iterations, str(config.data.resolve())):
                results[run.name] = result
    return results


def find_baselines(output: Path, layout: Layout, data: Path, category: str) -> list[Baseline]:
    """The baselines of a category: those in the output folder, or measured and stored there.

    Without the data set there are none, and a note says so. Raises ValueError for a damaged file.
    """
    path = output / "baselines" / f"{category}.json"
    if path.is_file():
        content = read_bytes(path, limits.JSON_BYTES, "the baselines of a data set as JSON")
        try:
            stored = TypeAdapter(list[Baseline]).validate_json(content)
        except ValueError as error:
            reason = " ".join(str(error).splitlines()[1:3])
            raise ValueError(
                f"{path} has no baselines ({reason}); remove it, and it is made again"
            ) from None
        if {baseline.data for baseline in stored} == {str(data.resolve())}:
            return stored
    if not data.is_dir():
        note(f"no rows for the mean shape of {category}: the data set {data} is not here")
        return []
    note(f"{category}: mean shape and nearest training object of {data}")
    baselines = measure_baselines(layout, data, category)
    path.parent.mkdir(parents=True, exist_ok=True)
    writing.write_json(path, [baseline.model_dump() for baseline in baselines])
    return baselines


def find_conflict(run: TrainConfig) -> str:
    """A sentence with the options in which the run in the folder differs; "" without any."""
    if not (run.output / run_folder.CONFIG).is_file():
        return ""
    asked, saved = (  # a run saves the precision that "auto" stands for
        dataclasses.replace(config, precision=resolve_precision(config.precision, config.device))
        for config in (run, load_config(run.output / run_folder.CONFIG))
    )
    changed = differences(asked, saved)
    return f"{run.output} has a run with other options: " + "; ".join(changed) if changed else ""


def describe_tables() -> str:
    """Every table with its methods, for --list."""
    lines = []
    for name, table in TABLES.items():
        lines.append(f"{name}: {table.title}")
        lines.append(
            f"  layout {table.layout}, {len(table.categories)} categories, seeds {table.seeds}"
        )
        for label, row in table.rows.items():
            about = ["quoted"]
            if variant := VARIANTS.get(row.variant):
                about = [
                    row.variant,
                    f"preset {variant.preset}",
                    *(f"{n}={v}" for n, v in variant.changes.items()),
                ]
            lines.append(f"  {label}: {', '.join(about)}")
    return "\n".join(lines)
