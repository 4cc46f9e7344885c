"""Writes one HTML file about trained runs: their settings and curves, their IoU, and meshes to turn by hand."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import jinja2
import numpy as np
import torch
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from learn3d.config import TrainConfig
from learn3d.evaluation import Evaluation, evaluate
from learn3d.experiments.measurement import MEASURES
from learn3d.experiments.plan import command_line
from learn3d.experiments.statistics import Interval, percentile_interval, resampled_means
from learn3d.figures.curves import TITLES, Curve, Key, panels, read_metrics
from learn3d.figures.plots import COLORS
from learn3d.figures.polar import profile
from learn3d.figures.runs import Run, open_runs
from learn3d.files import writing
from learn3d.pages.shapes import Faces, pack_shapes
from learn3d.pictures.surfaces import azimuths_deg
from learn3d.presets import PRESETS
from learn3d.runs import checkpoint
from learn3d.runs.checkpoint import Metadata
from learn3d.terminal import plain

POINTS = 500  # of a curve; of more, every n-th is drawn
MOST_SHOWN = 100  # images with shapes; each takes some 40 kB


@dataclass(frozen=True, eq=False)
class Measured:
    """A run and what came out of its evaluation."""

    run: Run
    about: Metadata
    result: Evaluation
    ious: np.ndarray  # float64 [M]: IoU of each image; NaN where it is not defined
    log: dict[Key, Curve]

    def by_object(self) -> tuple[np.ndarray, np.ndarray]:
        """(sum of the IoUs, number of IoUs) of each object, float64 [N]."""
        ids, known = self.run.dataset.object_ids, ~np.isnan(self.ious)
        size = self.run.dataset.num_objects
        sums = np.bincount(ids[known], weights=self.ious[known], minlength=size)
        return sums, np.bincount(ids[known], minlength=size).astype(np.float64)

    @functools.cached_property
    def object_means(self) -> np.ndarray:
        """Mean IoU of each object, float64 [N], NaN where it has none."""
        sums, counts = self.by_object()
        return np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)


def write_report(
    paths: Sequence[Path],
    output: Path,
    *,
    labels: Sequence[str] = (),
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    which: Literal["last", "best"] = "last",
    device: str = "cpu",
    objects: int = 12,
    indices: Sequence[int] = (),
    report_progress: Callable[[str], None] = lambda text: None,
) -> int:
    """Measure runs on a split as `learn3d evaluate` does and write the page; returns its size in bytes.

    `data` and `category` default to those that the runs were trained with, `labels` to the names of their presets.
    Shapes are shown of so many `objects`, from the best to the worst, each from a view that is typical of its IoU; or
    of the images `indices` (object * views + view). Raises ValueError or OSError, before anything is measured, where a
    checkpoint or its data is not there, and for runs that are not of one class and the same images.
    """
    abouts = [checkpoint.load_metadata(checkpoint.find(path, which)) for path in paths]
    _check_comparable([about.config for about in abouts], data, category)
    where = {"data": data, "category": category, "split": split, "which": which, "device": device}
    runs = open_runs(paths, labels=labels, report_progress=report_progress, **where)
    _check_same_images(runs)
    if not 1 <= (count := len(indices) or objects) <= MOST_SHOWN:
        raise ValueError(f"shapes can be shown of 1 to {MOST_SHOWN} images, and {count} are asked for")
    runs[0].dataset.batch(torch.tensor(indices, dtype=torch.int64))  # says which indices there are
    logs = [_log(path) for path in paths]  # before anything is measured
    measured = []
    for run, about, log in zip(runs, abouts, logs, strict=True):
        report_progress(f"measuring {run.label} on {len(run.dataset)} images")
        result = evaluate(run.method, run.dataset)
        values = next(iter(result.ious.values()), result.silhouette_iou)
        ious = np.full(len(run.dataset), np.nan) if values is None else values.double().numpy()
        measured.append(Measured(run, about, result, ious, log))
    ranked = _ranked(measured)
    page = _page(measured, ranked, _chosen(measured, ranked, objects, indices)) | {"split": split, "which": which}
    page["data"] = plain(Path(data or abouts[0].config.data).name)
    content = _render(page).encode()
    writing.write_bytes(output, content)
    return len(content)


def _check_comparable(configs: Sequence[TrainConfig], data: Path | None, category: str | None) -> None:
    """Raise ValueError where the runs have different data or categories and the user has not chosen one."""
    classes = list(dict.fromkeys(category or config.category for config in configs))
    if len(classes) > 1 or any("," in name for name in classes):
        raise ValueError(f"a report is about one class, and these runs are of {', '.join(classes)}; give --category")
    folders = list(dict.fromkeys(data or config.data.resolve() for config in configs))
    if len(folders) > 1:
        raise ValueError(
            f"these runs were trained on different data ({', '.join(map(str, folders))}); say with --data on which of "
            "them the report is to be"
        )


def _check_same_images(runs: Sequence[Run]) -> None:
    first = runs[0].dataset
    for run in runs[1:]:
        same = run.dataset.object_names == first.object_names
        if not (same and np.array_equal(run.dataset.object_ids, first.object_ids)):
            raise ValueError(f"{run.label} and {runs[0].label} read different images of this data; report them apart")


def _ranked(measured: Sequence[Measured]) -> np.ndarray:
    """Numbers of the objects that have images, int64 [n], sorted by their mean IoU over all runs, the best first."""
    present = np.unique(measured[0].run.dataset.object_ids)
    means = _mean([m.object_means for m in measured])[present]
    return present[np.argsort(-np.nan_to_num(means, nan=-1.0), kind="stable")]


def _chosen(measured: Sequence[Measured], ranked: np.ndarray, objects: int, indices: Sequence[int]) -> list[int]:
    """The images whose shapes are shown, the best object first."""
    ids, ious = measured[0].run.dataset.object_ids, _mean([m.ious for m in measured])
    if not indices:
        means = _mean([m.object_means for m in measured])
        for number in ranked[np.unique(np.linspace(0, len(ranked) - 1, min(objects, len(ranked))).round().astype(int))]:
            samples = np.flatnonzero(ids == number)
            indices = [*indices, samples[np.nan_to_num(np.abs(ious[samples] - means[number]), nan=9.0).argmin()]]
    place = {number: rank for rank, number in enumerate(ranked)}
    return sorted(map(int, dict.fromkeys(indices)), key=lambda sample: place[ids[sample]])


def _page(measured: Sequence[Measured], ranked: np.ndarray, samples: Sequence[int]) -> dict[str, Any]:
    """All that the template is filled with; "browser" is for its script."""
    dataset, first = measured[0].run.dataset, measured[0]
    kind = "silhouette IoU" if dataset.voxels is None else "voxel IoU"
    colors = [COLORS[number % (len(COLORS) - 1)] for number in range(len(measured))]  # the last is black
    runs = [{"name": plain(m.run.label), "color": color} for m, color in zip(measured, colors, strict=True)]
    faces: Faces = {}
    items = pack_shapes([m.run for m in measured], samples, faces)
    for item in items:
        item["ious"] = [_number(m.ious[item["index"]], 4) for m in measured]
        item["means"] = [_number(m.object_means[dataset.object_ids[item["index"]]], 4) for m in measured]
    place = {int(dataset.object_ids[sample]): number for number, sample in reversed(list(enumerate(samples)))}
    objects = [
        {
            "name": plain(dataset.object_names[number]),
            "ious": [_number(m.object_means[number], 4) for m in measured],
            "item": place.get(number),
        }
        for number in map(int, ranked)
    ]
    profiles = []
    if dataset.poses is not None:
        azimuths, none = azimuths_deg(dataset.poses).numpy(), np.full(len(dataset), np.nan)
        profiles = [profile(m.run.label, azimuths, m.ious, none, dataset.object_ids) for m in measured]
    browser = {
        "runs": runs,
        "items": items,
        "faces": [{axis: {"dtype": k[0], "bdata": k[1 + n]} for n, axis in enumerate("ijk")} for k in faces],
        "kind": kind,
        "views": [{"azimuths": p.azimuths_deg.tolist(), "ious": [_number(x, 4) for x in p.iou]} for p in profiles],
        "curves": _curves([m.log for m in measured]),
    }
    return {
        "runs": [_row(m, first) | run for m, run in zip(measured, runs, strict=True)],
        "category": plain(dataset.category),
        "images": len(dataset),
        "objects": objects,
        "kind": kind,
        "meaning": MEASURES["silhouette_iou" if dataset.voxels is None else "voxel_iou_kato18"][1],
        "mmd": MEASURES["mmd"][1],
        "truth": dataset.voxels is not None,
        "browser": browser,
    }


def _row(m: Measured, baseline: Measured) -> dict[str, Any]:
    """A run as the page's first table has it."""
    resampled, first = (resampled_means(*([part] for part in of.by_object())) for of in (m, baseline))
    config, step, kept = m.about.config, m.about.progress.step, m.about.versions
    commit = kept.get("commit") or ""
    code = [kept.get("nmr-learn3d"), commit[:9] + "-dirty" * commit.endswith("-dirty"), f"torch {kept.get('torch')}"]
    secret = {"data": "DATA", "output": "OUTPUT", "pretrained": "WEIGHTS"}  # paths of this machine
    iou, other = m.result.chosen_by[1], baseline.result.chosen_by[1]
    differs = m is not baseline and None not in (iou, other)
    return {
        "method": PRESETS[config.preset].label,
        "preset": config.preset,
        "category": plain(config.category),
        "iterations": step,
        "batch": config.batch_size,
        "seed": config.seed,
        "minutes": m.about.progress.seconds / 60,
        "code": plain(", ".join(filter(None, code))),
        "iou": iou,
        "interval": percentile_interval(resampled),
        "difference": iou - other if differs else None,
        "difference_interval": percentile_interval(resampled - first) if differs else None,
        "mmd": m.result.mmd,
        "command": plain(command_line(config, **secret)),
    }


def _log(path: Path) -> dict[Key, Curve]:
    """What a run has logged; nothing where there is no log, as beside a checkpoint file."""
    return read_metrics(path) if (Path(path) / "metrics.jsonl").is_file() else {}


def _curves(logs: Sequence[dict[Key, Curve]]) -> list[dict[str, Any]]:
    """The logged numbers as panels, validation first, with a line of each run."""
    found = []
    for split, name in panels({"": logs}) if any(logs) else ():
        lines = [log.get((split, name)) for log in logs]
        steps = [None if c is None else c.steps[:: len(c.steps) // POINTS + 1].tolist() for c in lines]
        values = [None if c is None else c.values[:: len(c.steps) // POINTS + 1] for c in lines]
        known = [None if v is None else [_number(x, 6) for x in v] for v in values]
        log_scale = split == "train" and all(v is None or v.min() > 0 for v in values)
        title = plain(f"{TITLES.get(name, name)}, {split}")
        found.append({"title": title, "steps": steps, "values": known, "log": log_scale})
    return found


def _mean(values: Sequence[np.ndarray]) -> np.ndarray:
    """Mean over the runs, without NaN; NaN where all runs have NaN."""
    stacked = np.stack(values)
    known = ~np.isnan(stacked)
    total = np.where(known, stacked, 0.0).sum(0)
    return np.divide(total, known.sum(0), out=np.full(stacked.shape[1], np.nan), where=known.any(0))


def _number(value: float, digits: int) -> float | None:
    """To so many significant digits; None for what JSON does not have."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None


def _render(page: dict[str, Any]) -> str:
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["interval"] = _interval
    folder = resources.files("learn3d.pages")
    style, script = (Markup(folder.joinpath(f"report.{kind}").read_text("utf-8")) for kind in ("css", "js"))
    template = environment.from_string(folder.joinpath("report.html").read_text("utf-8"))
    return template.render(page, style=style, script=script, plotly=Markup(get_plotlyjs()))


def _interval(interval: Interval | None, form: str = ".3f") -> str:
    return "" if interval is None else f"[{interval[0]:{form}}, {interval[1]:{form}}]"
