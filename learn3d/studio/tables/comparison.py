"""The report of a table from stored results: the paper's figures beside ours, intervals.

Our values are not subtracted from the paper's, which are for other meshes. Intervals over test
objects are by bootstrap, intervals over seeds by Student's t.
"""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from learn3d.data.conventions import SYNSETS
from learn3d.evaluation import ANGLES_DEG
from learn3d.files import limits
from learn3d.files.reading import read_json
from learn3d.presets import command_line
from learn3d.runs.baselines import BASELINES
from learn3d.runs.measurement import (
    HEADERS,
    MEASURES,
    Baseline,
    ObjectMeans,
    Result,
    format_measures,
)
from learn3d.studio.tables.plan import PlannedRun, Request, select_rows
from learn3d.studio.tables.tables import MEAN, TABLES, Row, Table

RESAMPLES = 2000
Cells = list[list[str]]
# results of one method for each category of a column, by seed; a baseline's seed is None
Side = list[dict[int | None, Result | Baseline]]
MeasuredRuns = Sequence[tuple[PlannedRun, Result]]

# measures that results of earlier versions lack
_LATER_MEASURES = {"voxel_iou_unclamped", "mmd_floor"}
# measures of the accuracy of a shape, and whether more is better
_ACCURACY = {"voxel_iou": True, "chamfer_l1": False, "f_score": True}

NOTES = (
    "Measured on the test split. Brackets: 95 % intervals over test objects (bootstrap; objects, not images, are drawn "
    "again). ±: 95 % intervals over seeds (Student's t).\n\nThe paper's figures are for reference: they are on its own "
    "data, with its own length of training. In parentheses: its mean over other categories than those here."
)
ABOUT_BASELINES = (
    "Mean shape: the cells that most training objects share, as the answer to every image. Nearest training "
    "object: the one with the highest IoU, which only an oracle finds. Random training object: the mean over all."
)
_POSE_ERRORS = {  # fields of the JSON file beside a table of poses, and the columns
    "accuracy": "Acc@30",
    "updated_accuracy": "after training",
    "half_turn_accuracy": "up to half a turn",
    "median_deg": "median error, degrees",
    "flips": "flips",
    "objects_flipped": "objects flipped",
    "confidence": "mean confidence",
}


def resampled_means(sums: Sequence[np.ndarray], counts: Sequence[np.ndarray]) -> np.ndarray:
    """Means of 2,000 resampled test sets, float64 [2000]; NaN if no image of a set has a value.

    sums[c], counts[c] float [N_c]: sum of a measure over the images of each object of category c,
    and their number. Objects are drawn with replacement within each category, because the images
    of an object depend on each other. The result is the mean over the images of a category, then
    over categories. The draws depend only on the numbers of objects. So results on the same
    objects can be subtracted: the bootstrap of their difference is paired. (scipy.stats.bootstrap
    has neither strata nor weights.)
    """
    rng = np.random.default_rng(0)
    means = []
    for of_objects, images in zip(sums, counts, strict=True):
        drawn = rng.integers(len(images), size=(RESAMPLES, len(images)))
        with np.errstate(invalid="ignore"):
            means.append(of_objects[drawn].sum(1) / images[drawn].sum(1))
    return np.mean(means, axis=0)


def percentile_interval(resampled: np.ndarray) -> tuple[float, float] | None:
    """The ends of the middle 95 % of resampled values; None if all are NaN."""
    known = resampled[np.isfinite(resampled)]
    return tuple(np.quantile(known, [0.025, 0.975]).tolist()) if len(known) else None


def make_report(
    request: Request,
    runs: Sequence[PlannedRun],
    results: Mapping[str, Result],
    baselines: Sequence[Baseline] = (),
) -> tuple[dict[str, Cells], str]:
    """The tables "main", "differences", "runs", "angles", "curves", perhaps "poses"; and their
    Markdown.

    "runs" has both checkpoints of a run, if they differ. "curves" has the validations of each run.
    The Markdown leaves them out. results: by name of the run. baselines: those of all categories. Commands
    have DATA and OUTPUT in place of folders, so that the report has no path of a machine.
    """
    table = TABLES[request.table]
    done = [(run, results[run.name]) for run in runs if run.name in results]
    rows = select_rows(request)
    main, differences = _compare_methods(table, rows, runs, done, baselines)
    trained = _run_rows(done)
    angles = _angle_rows(done)
    tables = {
        "main": main,
        "differences": differences,
        "runs": trained,
        "angles": angles,
        "curves": _curve_rows(done),
    }
    parts = [f"## {table.title}", _markdown(main), NOTES]
    if baselines:
        parts.append(ABOUT_BASELINES)
    if missing := [run.name for run in runs if run.name not in results]:
        parts.append(f"Missing: {', '.join(missing)}.")
    parts += [
        f"Differences to {table.baseline}, paired by seed and by object:",
        _markdown(differences),
        *_disagreements(table, rows, runs, done),
    ]
    if len(angles) > 1:
        parts += [
            "IoU of silhouettes by the angle between the azimuths of the input and of the camera, in degrees:",
            _markdown(angles),
        ]
    if len(poses := _pose_rows(runs, results)) > 1:
        tables["poses"] = poses
        parts += [
            "Estimated azimuths of all images, and voxel IoU (kato18) of the trainings:",
            _markdown(poses),
        ]
    commands = dict.fromkeys(_general_command(run) for run, _ in done)
    parts += ["What was run:", _markdown(trained), "\n".join(["```sh", *commands, "```"])]
    return tables, "\n\n".join(parts) + "\n"


def _by_method(done: MeasuredRuns) -> dict[tuple[str, str], dict[int, Result]]:
    """Results by variant and category, then by seed."""
    measured: dict[tuple[str, str], dict[int, Result]] = {}
    for run, result in done:
        measured.setdefault((run.variant, run.config.category), {})[run.config.seed] = result
    return measured


def _compare_methods(
    table: Table,
    rows: Mapping[str, Row],
    runs: Sequence[PlannedRun],
    done: MeasuredRuns,
    baselines: Sequence[Baseline],
) -> tuple[Cells, Cells]:
    """Printed and measured values of each row by category, and differences to the baseline."""
    measured = _by_method(done)
    without_network = {(b.name, b.category): {None: b} for b in baselines}
    categories = list(dict.fromkeys(run.config.category for run in runs))
    columns = {name: [name] for name in categories} | {MEAN: categories}

    def results_of(name: str, found: Mapping[tuple[str, str], dict] = measured) -> list[Side]:
        """The results of a variant for each column."""
        return [[found.get((name, category), {}) for category in c] for c in columns.values()]

    measures = {"voxel_iou": "kato18", "voxel_iou_kato19": "kato19"}
    measures["voxel_iou_unclamped"] = "kato18, without clamp"
    if table.measure == "mmd":
        measures = {"mmd": "mmd", "mmd_floor": "mmd, views shuffled"}
    baseline = table.rows[table.baseline].variant
    main = [["method", "", *columns]]
    differences = [["method", *columns]]
    for label, row in rows.items():
        if row.printed:
            printed = [_format_printed(row.printed, column, categories) for column in columns]
            main.append([label, f"paper ({row.about})", *printed])
        if not row.variant:
            continue
        ours = results_of(row.variant)
        for measure, name in measures.items():
            cells = [_compare(measure, side) for side in ours]
            if measure not in _LATER_MEASURES or set(cells) != {"-"}:
                main.append([label, f"here ({name})", *cells])
        if row.variant != baseline:
            pairs = zip(ours, results_of(baseline), strict=True)
            differences.append([label, *(_compare(table.measure, *pair) for pair in pairs)])
    if baselines:
        for name in BASELINES:
            ours = results_of(name, without_network)
            main.append([name, "here (voxels)", *(_compare("voxel_iou", side) for side in ours)])
            pairs = zip(ours, results_of(baseline), strict=True)
            differences.append([name, *(_compare("voxel_iou", *pair) for pair in pairs)])
    return main, differences


def _disagreements(
    table: Table, rows: Mapping[str, Row], runs: Sequence[PlannedRun], done: MeasuredRuns
) -> list[str]:
    """A sentence for each method and category on which measures of accuracy disagree about it and
    the baseline.
    """
    measured = _by_method(done)
    found = []
    for category in dict.fromkeys(run.config.category for run in runs):
        theirs = measured.get((table.rows[table.baseline].variant, category), {})
        for label, row in rows.items():
            ours = measured.get((row.variant, category), {})
            prefer: dict[str, list[str]] = {}
            for name, more_is_better in _ACCURACY.items():
                values = [[getattr(r, name) for r in side.values()] for side in (ours, theirs)]
                if all(side and None not in side for side in values):
                    difference = np.mean(values[0]) - np.mean(values[1])
                    if difference:
                        better = label if (difference > 0) == more_is_better else table.baseline
                        prefer.setdefault(better, []).append(MEASURES[name][0])
            if len(prefer) == 2:
                sides = (f"{' and '.join(names)} for {who}" for who, names in prefer.items())
                found.append(f"Measures disagree on {category}: {', '.join(sides)}.")
    return found


def _run_rows(done: MeasuredRuns) -> Cells:
    """A header, and the measures of each run; a second row has its other checkpoint."""
    rows = [["run", "networks", "iterations", "batch", "images", *HEADERS, "minutes", "commit"]]
    for run, result in done:
        for measured in filter(None, (result, result.other)):
            which = Path(measured.checkpoint).stem
            counts = [
                f"step {measured.step}" + (f" ({which})" if result.other else ""),
                str(measured.iterations),
                str(run.config.batch_size),
                str(measured.images),
            ]
            minutes = "-" if measured.seconds is None else f"{measured.seconds / 60:.1f}"
            values = format_measures(vars(measured))
            rows.append([run.name, *counts, *values, minutes, measured.commit])
    return rows


def _angle_rows(done: MeasuredRuns) -> Cells:
    """A header of angles in degrees, and the IoU of silhouettes of each run that has them."""
    rows = [["run", *map(str, ANGLES_DEG)]]
    for run, result in done:
        if known := dict(result.angles):
            values = [known.get(angle) for angle in ANGLES_DEG]
            rows.append([run.name, *("-" if v is None else f"{v:.4f}" for v in values)])
    return rows


def _curve_rows(done: MeasuredRuns) -> Cells:
    """A header, and the validations of each run."""
    rows = [["run", "split", "step", HEADERS[0], "MMD"]]
    for run, result in done:
        for split, step, *values in result.curve:
            rows.append(
                [
                    run.name,
                    split,
                    str(step),
                    *("-" if v is None else f"{v:.4f}" for v in values),
                ]
            )
    return rows


def _general_command(run: PlannedRun) -> str:
    """The command of a run, with words in place of folders, category and seed."""
    return command_line(
        run.config,
        data="DATA",
        category="CATEGORY",
        seed="SEED",
        poses="OUTPUT/poses/CATEGORY-seedSEED.npz",
        output=f"OUTPUT/runs/CATEGORY/{run.variant}-seedSEED",
    )


def _format_printed(printed: Mapping[str, float], column: str, categories: Sequence[str]) -> str:
    """The paper's figure for a column.

    Its mean is over the same categories as ours, else in parentheses.
    """
    if column == MEAN and set(categories) != (set(printed) - {MEAN} or set(SYNSETS)):
        if all(name in printed for name in categories):
            return f"{np.mean([printed[name] for name in categories]):.3f}"
        return f"({printed[MEAN]:.3f})" if MEAN in printed else "-"
    return f"{printed[column]:.3f}" if column in printed else "-"


def _compare(measure: str, *sides: Side) -> str:
    """The mean of a method, or the difference of two, with intervals; "-" without results."""
    values = [
        [[getattr(r, measure) for r in by_seed.values()] for by_seed in side] for side in sides
    ]
    if not all(v and None not in v for side in values for v in side):
        return "-"
    form = ".3f" if len(sides) == 1 else "+.3f"
    means = [np.mean([np.mean(v) for v in side]) for side in values]
    text = format(means[0] - sum(means[1:]), form)
    seeds = list(sides[0][0])
    if len(seeds) > 1 and all(list(by_seed) == seeds for side in sides for by_seed in side):
        ours, *theirs = (np.mean(side, axis=0) for side in values)
        text += f" ±{stats.t.ppf(0.975, len(seeds) - 1) * stats.sem(ours - sum(theirs)):.3f}"
    if measure not in ObjectMeans._fields:
        return text + (f" (x {means[0] / means[1]:.2f})" if len(means) == 2 else "")
    if _have_same_objects(sides):  # others cannot be resampled together
        ours, *theirs = (_resample(measure, side) for side in sides)
        if interval := percentile_interval(ours - sum(theirs)):
            text += f" [{interval[0]:{form}}, {interval[1]:{form}}]"
    return text


def _have_same_objects(sides: Sequence[Side]) -> bool:
    """Whether all results of each category are of the same objects."""
    for of_category in zip(*sides, strict=True):
        results = [result for by_seed in of_category for result in by_seed.values()]
        if len({tuple(o.name for o in result.objects) for result in results}) > 1:
            return False
    return True


def _resample(measure: str, side: Side) -> np.ndarray:
    """Mean IoUs over resampled objects [2000]. The IoUs of an object are those of all seeds."""
    sums, counts = [], []
    for by_seed in side:
        images = np.array(
            [[o.images for o in result.objects] for result in by_seed.values()], float
        )
        means = [
            [getattr(o, measure) or 0.0 for o in result.objects] for result in by_seed.values()
        ]
        sums.append((means * images).sum(0))
        counts.append(images.sum(0))
    return resampled_means(sums, counts)


def read_pose_errors(poses: Path) -> dict[str, float]:
    """The JSON file beside a table of estimated poses."""
    return read_json(
        poses.with_suffix(".json"), limits.JSON_BYTES, "the errors of a table of poses"
    )


def _pose_rows(runs: Sequence[PlannedRun], results: Mapping[str, Result]) -> Cells:
    """A header; errors of each run's estimated poses, and its IoU beside that on known poses."""
    known = {
        (run.config.category, run.config.seed): results.get(run.name)
        for run in runs
        if run.config.poses is None
    }
    by_category: dict[str, dict[str, Sequence[float]]] = {}
    for run in runs:
        config = run.config
        both = known.get((config.category, config.seed)), results.get(run.name)
        if config.poses is not None and None not in both:
            errors = read_pose_errors(config.poses)
            ious = [result.voxel_iou for result in both]
            values = [*(errors[name] for name in _POSE_ERRORS), *ious, ious[1] / ious[0]]
            by_category.setdefault(config.category, {})[str(config.seed)] = values
    rows = [
        [
            "category",
            "seed",
            *_POSE_ERRORS.values(),
            "IoU, known poses",
            "IoU, estimated poses",
            "ratio",
        ]
    ]
    for category, by_seed in by_category.items():
        if len(by_seed) > 1:
            by_seed["mean"] = np.mean(list(by_seed.values()), axis=0)
        for seed, values in by_seed.items():
            cells = [
                f"{value:.1f}" if place == 3 else f"{value:.3f}"
                for place, value in enumerate(values)
            ]
            rows.append([category, seed, *cells])
    return rows


def _markdown(table: Cells) -> str:
    """The table as Markdown. HTML is escaped: names in results come from untrusted files."""
    cells = [
        [html.escape(" ".join(c.splitlines()), quote=False).replace("|", "\\|") for c in row]
        for row in table
    ]
    lines = ["| " + " | ".join(row) + " |" for row in cells]
    return "\n".join([lines[0], "|" + "---|" * len(cells[0]), *lines[1:]])
