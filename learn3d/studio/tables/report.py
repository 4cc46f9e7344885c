"""Writes one HTML file about trained runs: settings, curves, IoU, and meshes to turn."""

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import jinja2
import numpy as np
import torch
from markupsafe import Markup
from PIL import Image
from plotly.offline import get_plotlyjs

from learn3d.data.conventions import mesh_to_object
from learn3d.data.poses import LookAtPoses
from learn3d.evaluation import Evaluation, evaluate
from learn3d.files import limits, writing
from learn3d.files.reading import read_bytes
from learn3d.pictures import Surface, azimuths_deg, grid_surface, natural_colors
from learn3d.presets import command_line
from learn3d.runs.folder import METRICS
from learn3d.runs.log import read_records
from learn3d.runs.measurement import MEASURES
from learn3d.settings import LARGEST
from learn3d.studio.picture_to_mesh.smoothing import smooth
from learn3d.studio.tables.comparison import percentile_interval, resampled_means
from learn3d.studio.tables.trained_models import TrainedModel, open_runs
from learn3d.terminal import note, plain

UNIT = 1e-4  # length of 1 in the stored int16 coordinates, which reach 3.3; objects reach 1
#: Maps row vectors of the object frame to the page's axes, with z up (y is up in mesh files).
_TO_PAGE = mesh_to_object() @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
#: Okabe and Ito's colours, safe for every kind of colour vision, darker ones first, without the
#: faint yellow.
COLORS = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
#: Titles of curves. Other curves have the name under which they are logged.
TITLES = {
    "projection": "projection loss (1 - IoU)",
    "smoothness": "smoothness loss",
    "prior": "prior loss",
    "confusion": "confusion loss (adversarial)",
    "classification": "classification loss (discriminator)",
    "total": "total loss (weighted)",
    "voxel_iou": "voxel IoU",
    "precision": "precision of voxels",
    "recall": "recall of voxels",
    "silhouette_iou": "silhouette IoU",
    "mmd": "MMD between views",
}
# The first curves; the others follow in the order of the log.
_FIRST = (
    "voxel_iou",
    "mmd",
    "projection",
    "total",
)
_NOT_CURVES = {"hollow", "seconds"}
SECTOR_DEG = 15
CURVE_POINTS = 500  # the most points of a curve: every n-th is drawn of a longer one
MOST_SHOWN = 100  # images with shapes; each takes some 60 kB
#: All curves of a run: by split ("train", "val") and name, the value at each step, in the order
#: of the steps.
Log = dict[tuple[str, str], dict[int, float]]


def write_report(
    paths: Sequence[Path],
    output: Path,
    *,
    labels: Sequence[str] = (),
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    which: Literal["last", "best"] = "last",
    objects: int = 12,
) -> int:
    """Measure runs as `learn3d evaluate` does, and write the page; returns its size in bytes.

    objects: number of objects whose shapes are shown, from the best to the worst, each in an
    image of typical IoU. The other options are those of `open_runs`. Raises ValueError or
    OSError, before anything is measured, for missing files, several categories or different
    images.
    """
    if not 1 <= objects <= MOST_SHOWN:
        raise ValueError(f"the page can show the shapes of 1 to {MOST_SHOWN} images, got {objects}")
    runs = open_runs(paths, labels=labels, data=data, category=category, split=split, which=which)
    _check_same_images(runs, data)
    logs = [read_metrics(path) if (Path(path) / METRICS).is_file() else {} for path in paths]
    results = []
    for run in runs:
        note(f"measuring {run.label} on {len(run.dataset)} images")
        results.append(evaluate(run.method, run.dataset, title=run.label))
    page = _measure(runs, results, objects) | {"split": split, "which": which}
    page["data"] = plain((data or runs[0].metadata.config.data).name)
    page["browser"]["curves"] = draw_curves(logs)
    texts = {
        kind: Path(__file__).with_suffix(f".{kind}").read_text("utf-8")
        for kind in ("html", "css", "js")
    }
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["plain"] = plain
    parts = {
        "style": Markup(texts["css"]),
        "script": Markup(texts["js"]),
        "plotly": Markup(get_plotlyjs()),
    }
    content = environment.from_string(texts["html"]).render(page, **parts).encode()
    writing.write_bytes(output, content)
    return len(content)


def _check_same_images(runs: Sequence[TrainedModel], data: Path | None) -> None:
    classes = dict.fromkeys(run.dataset.category for run in runs)
    if len(classes) > 1 or "," in next(iter(classes)):
        raise ValueError(
            f"a report is about one class, and these runs are of {', '.join(classes)}; give --category"
        )
    folders = sorted({str(data or run.metadata.config.data.resolve()) for run in runs})
    if len(folders) > 1:
        read = ", ".join(folders)
        raise ValueError(
            f"these runs were trained on different data ({read}); give --data to measure all on one"
        )
    images = [(run.dataset.object_names, run.dataset.object_ids.tolist()) for run in runs]
    for run, read in zip(runs, images, strict=True):
        if read != images[0]:
            raise ValueError(
                f"{run.label} and {runs[0].label} read different images of this data; report them apart"
            )


def _measure(
    runs: Sequence[TrainedModel],
    results: Sequence[Evaluation],
    objects: int,
) -> dict[str, Any]:
    """The values of the template; "browser" is for the script of the page."""
    dataset = runs[0].dataset
    names = [plain(name) for name in dataset.object_names]
    metric, kind = "silhouette_iou", "silhouette IoU"
    if dataset.voxels is not None:
        metric, kind = "voxel_iou", "voxel IoU"
    ious = np.stack([result.values[metric].numpy() for result in results])  # run by image
    ids = dataset.object_ids
    sums = np.stack([np.bincount(ids, np.nan_to_num(row), len(names)) for row in ious])
    counts = np.stack([np.bincount(ids, ~np.isnan(row), len(names)) for row in ious])
    # run by object
    means = np.divide(sums, counts, out=np.full_like(sums, np.nan), where=counts > 0)
    resampled = [resampled_means([s], [count]) for s, count in zip(sums, counts, strict=True)]

    of_objects = _mean(means, axis=0)
    numbers = np.unique(ids)
    # the best object first
    ranked = numbers[np.argsort(-np.nan_to_num(of_objects[numbers], nan=-1.0), kind="stable")]
    shown = _typical_images(_mean(ious, axis=0), of_objects, ids, ranked, objects)
    items = pack_shapes(runs, shown)
    for item, sample in zip(items, shown, strict=True):
        item |= {"ious": _numbers(ious[:, sample]), "means": _numbers(means[:, ids[sample]])}
    first_item = {ids[sample]: number for number, sample in reversed(list(enumerate(shown)))}
    views = []
    if dataset.poses is not None:
        by_view = [mean_by_azimuth(azimuths_deg(dataset.poses).numpy(), row) for row in ious]
        views = [
            {"azimuths": azimuths.tolist(), "ious": _numbers(values)}
            for azimuths, values in by_view
        ]
    legend = [
        {"name": plain(run.label), "color": COLORS[k % len(COLORS)]} for k, run in enumerate(runs)
    ]
    return {
        "runs": _describe_all(legend, runs, results, resampled, metric),
        "category": plain(dataset.category),
        "images": len(dataset),
        "objects": [
            {"name": names[n], "ious": _numbers(means[:, n]), "item": first_item.get(n)}
            for n in ranked
        ],
        "kind": kind,
        "meaning": MEASURES[metric][1],
        "mmd": MEASURES["mmd"][1],
        "truth": dataset.voxels is not None,
        "browser": {"runs": legend, "items": items, "kind": kind, "views": views, "unit": UNIT},
    }


def _describe_all(
    legend: Sequence[dict[str, str]],
    runs: Sequence[TrainedModel],
    results: Sequence[Evaluation],
    resampled: Sequence[np.ndarray],
    metric: str,
) -> list[dict[str, Any]]:
    """The runs' rows of the first table, with their differences to the first run."""
    rows: list[dict[str, Any]] = []
    for entry, run, result, samples in zip(legend, runs, results, resampled, strict=True):
        config = run.metadata.config
        row = entry | {
            "about": run.metadata,
            "method": config.label,
            "mmd": result.means.get("mmd"),
            "iou": result.means.get(metric),
            "interval": percentile_interval(samples),
            "command": command_line(config, data="DATA", output="OUTPUT", pretrained="WEIGHTS"),
        }
        if rows and None not in (row["iou"], rows[0]["iou"]):
            row["difference"] = row["iou"] - rows[0]["iou"]
            row["difference_interval"] = percentile_interval(samples - resampled[0])
        rows.append(row)
    return rows


def _typical_images(
    of_images: np.ndarray, of_objects: np.ndarray, ids: np.ndarray, ranked: np.ndarray, count: int
) -> list[int]:
    """Of `count` objects, from the best to the worst, the image with the most typical IoU."""
    order = np.nan_to_num(np.abs(of_images - of_objects[ids]), nan=9.0).argsort(kind="stable")
    typical = dict(zip(ids[order[::-1]], order[::-1], strict=True))
    places = np.unique(np.linspace(0, len(ranked) - 1, min(count, len(ranked))).round().astype(int))
    return [int(typical[number]) for number in ranked[places]]


def mean_by_azimuth(azimuths_deg: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths float64 [D] of the sectors that have images, and means of their values, or NaN.

    Sectors have 15 degrees and are centred at 0, 15, 30 ... azimuths_deg, values: float [M].
    """
    sectors, ids = np.unique(
        np.round(azimuths_deg / SECTOR_DEG) % (360 / SECTOR_DEG), return_inverse=True
    )
    return SECTOR_DEG * sectors, np.array(
        [_mean(values[ids == number]) for number in range(len(sectors))]
    )


def _mean(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """The mean of the values that are not NaN; NaN if all are."""
    return np.ma.filled(np.ma.masked_invalid(values).mean(axis), np.nan)


@torch.no_grad()
def pack_shapes(runs: Sequence[TrainedModel], samples: Sequence[int]) -> list[dict[str, Any]]:
    """For each image the picture and its meshes: one of each run, then the true shape, if known.

    "reach" is the largest radius of the meshes, "eye" the direction of the camera (an oblique one
    if it is unknown).
    """
    dataset = max((run.dataset for run in runs), key=lambda dataset: dataset.image_size)
    batch = dataset.batch(torch.tensor(samples))
    images = [run.dataset.batch(torch.tensor(samples)).images for run in runs]
    shapes = [
        run.method.decode(run.method.encode(own)).surfaces()
        for run, own in zip(runs, images, strict=True)
    ]
    if batch.voxels is not None:
        grids = dataset.convention.to_object(batch.voxels).float()
        surfaces = [grid_surface(grid, box=dataset.convention.cube_side) for grid in grids]
        shapes.append(
            [Surface(smooth(s.vertices, s.faces), s.faces) if len(s.faces) else s for s in surfaces]
        )
    pictures = natural_colors(batch.images.numpy(), inverted=dataset.inverted)
    oblique = LookAtPoses(torch.full((len(samples),), -30.0), 20.0, 1.0, 15.0)
    cameras = (batch.poses or oblique).eyes().double().numpy() @ _TO_PAGE
    cameras /= np.linalg.norm(cameras, axis=1, keepdims=True)
    items = []
    for number, (sample, *surfaces) in enumerate(zip(samples, *shapes, strict=True)):
        Image.fromarray(pictures[number]).save(png := io.BytesIO(), "png")
        item = {
            "name": plain(dataset.object_names[int(batch.object_ids[number])]),
            "view": plain(dataset.view_names[int(batch.view_ids[number])]),
            "index": sample,
            "image": "data:image/png;base64," + base64.b64encode(png.getvalue()).decode(),
            "eye": cameras[number].round(4).tolist(),
            "reach": max(
                [float(s.vertices.norm(dim=1).max()) for s in surfaces if len(s.faces)], default=1
            )
            / UNIT,
            "meshes": [_mesh(surface) for surface in surfaces],
        }
        items.append(item)
    return items


def _mesh(surface: Surface) -> dict[str, Any]:
    """A surface in plotly's encoding of arrays."""
    points = np.rint(surface.vertices.double().numpy() @ _TO_PAGE / UNIT).clip(-32767, 32767)
    # reversed, because the object frame is left-handed
    corners = surface.faces.numpy()[:, [0, 2, 1]]
    kind = "<u2" if len(points) <= 2**16 else "<u4"
    arrays = dict(zip("xyzijk", [*points.T.astype("<i2"), *corners.T.astype(kind)], strict=True))
    packed = {
        name: {"dtype": values.dtype.str[1:], "bdata": base64.b64encode(values.tobytes()).decode()}
        for name, values in arrays.items()
    }
    return packed | {"empty": len(corners) == 0}


def read_metrics(folder: Path) -> Log:
    """The curves in a run folder's metrics.jsonl, without damaged lines.

    Raises FileNotFoundError without such a file, and ValueError for one above 256 MiB or without
    numbers.
    """
    file = Path(folder) / METRICS
    curves: Log = {}
    for _, record in read_records(read_bytes(file, limits.METRICS_BYTES, "the metrics of a run")):
        step, split = record.pop("step"), record.pop("split")
        for name, value in record.items():
            title, known = f"{split} {name}", type(value) in (int, float) and abs(value) <= LARGEST
            if (
                known
                and name not in _NOT_CURVES
                and title.isprintable()
                and len(title) <= limits.CURVE_NAME
            ):
                curves.setdefault((split, name), {})[step] = float(value)
    if not 0 < len(curves) <= limits.CURVES:
        raise ValueError(
            f"{file} holds {len(curves)} different numbers; from 1 to {limits.CURVES} are drawn"
        )
    return {key: dict(sorted(curve.items())) for key, curve in curves.items()}


def draw_curves(logs: Sequence[Log]) -> list[dict[str, Any]]:
    """A plot for each number in the logs, with a line per run; those of the validation first."""
    keys = dict.fromkeys(key for log in logs for key in log)
    plots = []
    for split, name in sorted(
        keys, key=lambda key: (key[0] == "train", [*_FIRST, key[1]].index(key[1]))
    ):
        lines = [list(log.get((split, name), {}).items()) for log in logs]
        lines = [line[:: len(line) // CURVE_POINTS + 1] for line in lines]
        plot = {"title": plain(f"{TITLES.get(name, name)}, {split}")}
        plot["steps"] = [[step for step, _ in line] or None for line in lines]
        plot["values"] = [_numbers([value for _, value in line]) for line in lines]
        plot["log"] = split == "train" and all(value > 0 for line in lines for _, value in line)
        plots.append(plot)
    return plots


def _numbers(values: Sequence[float]) -> list[float | None]:
    """The values to five significant digits; None for NaN and infinity, which JSON lacks."""
    return [float(f"{value:.5g}") if np.isfinite(value) else None for value in values]
