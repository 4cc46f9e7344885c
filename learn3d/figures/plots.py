"""The paper's plots with axes, drawn by matplotlib in one style. No window opens."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import skimage.color
import torch
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator
from sklearn.dummy import DummyClassifier
from sklearn.manifold import TSNE
from sklearn.model_selection import GroupKFold
from sklearn.neighbors import KNeighborsClassifier

from learn3d.data.dataset import ViewDataset
from learn3d.evaluation import occupancy, spread_samples
from learn3d.figures.curves import COLORS, Curve, Log, mean, mean_by_azimuth, panels, title_of
from learn3d.figures.runs import Run
from learn3d.files import writing
from learn3d.methods import Method
from learn3d.pictures.surfaces import azimuths_deg

MOST_CODES = 2000  # images whose codes are laid out
FEWEST_CODES = 10  # below, neither an embedding nor a share says anything
LINES = [{"color": color, "linestyle": dashes} for dashes in ("-", "--", "-.", ":") for color in COLORS]
_styled = matplotlib.rc_context(  # a decorator, which leaves the settings of others alone
    {
        "font.size": 9,
        "axes.titlesize": 9.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.color": "#dddddd",
        "grid.linewidth": 0.6,
        "axes.axisbelow": True,
        "lines.linewidth": 1.6,
        "legend.frameon": False,
        "text.parse_math": False,  # names are names, whatever dollars are in them
        "svg.hashsalt": "learn3d",  # the same drawing gives the same file
        "svg.fonttype": "none",
    }
)


@_styled
@torch.no_grad()
def draw_tsne(runs: Sequence[Run]) -> Figure:
    """The shape codes of up to 2,000 images by t-SNE, a map for each run, coloured by the azimuths of the cameras.

    A map says the share of the view that is in its codes, and a wheel which colour is which azimuth. Raises ValueError
    for data of fewer than 10 images or without poses.
    """
    side, columns = 3.2, min(4, len(runs))
    rows = -(-len(runs) // columns)
    figure = Figure(figsize=(side * columns + 1.6, (side + 0.5) * rows))
    grid = figure.add_gridspec(rows, columns + 1, width_ratios=[side] * columns + [1.3], wspace=0.1, hspace=0.28)
    wheel = ListedColormap(cyclic_colors())
    for index, run in enumerate(runs):
        dataset = run.dataset
        samples = spread_samples(dataset.object_ids, dataset.view_ids, min(MOST_CODES, len(dataset)))
        batches = [run.method.encode(dataset.batch(part).images).float().cpu() for part in samples.split(256)]
        codes, rows = torch.cat(batches).numpy(), samples.numpy()
        points, color = embed(codes), wheel(azimuths_deg(dataset.poses)[samples].numpy() / 360 % 1.0)
        order = np.random.default_rng(0).permutation(len(points))  # else the last views would cover the others
        size = float(np.clip(7000 / len(points), 4, 16))
        axes = figure.add_subplot(grid[index // columns, index % columns])
        axes.scatter(*points[order].T, c=color[order], s=size, linewidths=0, rasterized=len(points) > 3000)
        axes.set(xticks=[], yticks=[])
        axes.set_title(run.label, fontsize=11, pad=18)
        accuracy = view_accuracy(codes, dataset.view_ids[rows], dataset.object_ids[rows])
        told = "view told from the code: {:.0%} (chance {:.0%})".format(*accuracy) if accuracy else ""
        axes.text(0.5, 1.02, told.replace("%", " %"), transform=axes.transAxes, ha="center", va="bottom", fontsize=8)
        axes.margins(0.06)
        axes.spines[["top", "right"]].set_visible(True)
        axes.spines[:].set_color("#bbbbbb")
    axes = figure.add_subplot(grid[:, -1], projection="polar")
    edges = np.linspace(0, 2 * np.pi, 361)
    middles = (edges[1:] + edges[:-1]) / 2
    axes.pcolormesh(edges, [0.58, 1.0], middles[None], cmap=wheel, vmin=0, vmax=2 * np.pi, rasterized=True)
    axes.set_theta_zero_location("S")  # as seen from above: camera 0 stands below, azimuth 90 to the right
    axes.set(ylim=(0, 1), yticks=[])
    axes.set_thetagrids([0, 90, 180, 270], ["0°", "90°", "180°", "270°"], fontsize=8)
    axes.tick_params(pad=-1)
    axes.grid(False)
    axes.spines["polar"].set_visible(False)
    axes.text(0, 0, "azimuth\nof the view", ha="center", va="center", fontsize=6.5)
    return figure


def embed(codes: np.ndarray) -> np.ndarray:
    """Codes float [M, C] in the plane by t-SNE, float32 [M, 2]: the same points for the same codes."""
    if len(codes) < FEWEST_CODES:
        raise ValueError(f"an embedding needs codes [M, C] of at least {FEWEST_CODES} images, got {list(codes.shape)}")
    tsne = TSNE(n_components=2, perplexity=min(30.0, (len(codes) - 1) / 3), init="pca", random_state=0)
    return tsne.fit_transform(np.ascontiguousarray(codes, np.float32))


def view_accuracy(codes: np.ndarray, view_ids: np.ndarray, object_ids: np.ndarray) -> tuple[float, float] | None:
    """How well the view class is read from a code: (share predicted right by 5 nearest neighbours, share by chance).

    Codes float [M, C]. Neighbours are sought among the images of other objects (5-fold cross-validation over objects):
    other views of the same object lie nearest in a code without pose, and would count as wrong answers. Chance is the
    most frequent view of the other objects. None with a single object or view.
    """
    objects = len(np.unique(object_ids))
    if objects < 2 or len(np.unique(view_ids)) < 2:
        return None
    folds = list(GroupKFold(min(5, objects)).split(codes, view_ids, object_ids))
    neighbours = min(5, *(len(train) for train, _ in folds))
    models = KNeighborsClassifier(neighbours), DummyClassifier(strategy="most_frequent")
    right = [[model.fit(codes[a], view_ids[a]).score(codes[b], view_ids[b]) for a, b in folds] for model in models]
    return tuple(np.average(shares, weights=[len(b) for _, b in folds]) for shares in right)


def cyclic_colors(count: int = 256) -> np.ndarray:
    """Colours of a full turn, float [count, 3] in [0, 1]: no jump at its end, opposite directions clearly different.

    A circle in CIE Lab through lightness and the blue-yellow axis, which every kind of colour vision sees, with some
    red-green in between: dark violet, blue, light green, brown. None is too light for a white page.
    """
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    lab = np.stack([54 - 28 * np.cos(angle), 24 * np.cos(angle) - 16 * np.sin(angle), -50 * np.sin(angle)], axis=1)
    return skimage.color.lab2rgb(lab[None])[0].clip(0, 1)


@_styled
def draw_curves(runs: Mapping[str, Sequence[Log]]) -> Figure:
    """A panel for every logged number; in it a line per label, the mean over its runs, with their range as a band.

    runs: for each label the curves (`read_metrics`) of one run or of several that differ in their seed.
    """
    every = [run for of_label in runs.values() for run in of_label]
    keys = panels(every)
    columns = min(3, len(keys))
    rows = -(-len(keys) // columns)
    figure = Figure(figsize=(3.5 * columns, 2.5 * rows + 0.4))
    grid = figure.subplots(rows, columns, squeeze=False)
    last_step = max(step for run in every for curve in run.values() for step in curve)
    for place, (axes, key) in enumerate(zip(grid.flat, keys, strict=False)):
        for line, of_label in zip(LINES * len(runs), runs.values(), strict=False):
            if known := [run[key] for run in of_label if key in run]:
                steps, *values = band(known)
                axes.plot(steps, values[0], **line, marker="o" if len(steps) <= 30 else "", markersize=3)
                if len(known) > 1:
                    axes.fill_between(steps, *values[1:], color=line["color"], alpha=0.2, linewidth=0)
        axes.set_title(title_of(key), loc="left")
        axes.set_xlim(0, 1.02 * last_step)
        axes.set_xlabel("training step" if place >= len(keys) - columns else "")
        if key[0] == "train" and all(value > 0 for run in every for value in run.get(key, {}).values()):
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_locator(NullLocator())
    for axes in grid.flat[len(keys) :]:
        axes.set_visible(False)
    handles = [Line2D([], [], **line) for line, _ in zip(LINES * len(runs), runs, strict=False)]
    labels = [f"{label} ({len(r)} seeds: mean and range)" if len(r) > 1 else label for label, r in runs.items()]
    figure.legend(handles, labels, loc="upper left", ncols=min(4, len(labels)), fontsize=9)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.35 / figure.get_figheight()))
    return figure


def band(curves: Sequence[Curve]) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray]:
    """The T steps that all curves have, and mean, lowest and highest value at each, float64 [T]."""
    steps = sorted(set.intersection(*map(set, curves)))
    rows = np.array([[curve[step] for step in steps] for curve in curves])
    return steps, rows.mean(axis=0), rows.min(axis=0), rows.max(axis=0)


@_styled
def draw_polar(runs: Sequence[Run]) -> Figure:
    """Voxel IoU by the azimuth of the camera, seen from above: with the truth, and among the shapes of an object.

    The second plot is left out if no object was seen from two sides. Raises ValueError for data without true voxels.
    """
    with_truth, among_views = [], []
    for run in runs:
        ious, agreement, consistency = measure(run.method, run.dataset)
        azimuths = azimuths_deg(run.dataset.poses).numpy()
        with_truth.append((f"{run.label}: {mean(ious):.3f}", *mean_by_azimuth(azimuths, ious)))
        among_views.append((f"{run.label}: {consistency:.3f}", *mean_by_azimuth(azimuths, agreement)))
    shown = {"with the truth": with_truth}
    if not all(np.isnan(values).all() for *_, values in among_views):
        shown["among the shapes from different views of an object"] = among_views
    figure = Figure(figsize=(4.2 * len(shown), 4.6 + 0.2 * len(runs)))
    for place, (title, profiles) in enumerate(shown.items(), start=1):
        axes = figure.add_subplot(1, len(shown), place, projection="polar")
        for line, (label, azimuths, values) in zip(LINES * len(runs), profiles, strict=False):
            theta, radius = np.deg2rad(np.append(azimuths, azimuths[0])), np.append(values, values[0])
            axes.plot(theta, radius, marker="o", markersize=2.5, label=label, **line)
        largest = max(np.nan_to_num(values).max() for *_, values in profiles)
        axes.set_ylim(0, float(np.clip(np.ceil(largest * 10 + 0.2) / 10, 0.1, 1.0)))
        axes.set_yticks(np.arange(0.2, axes.get_ylim()[1] + 1e-6, 0.2))
        axes.set_theta_zero_location("S")  # camera 0 stands below, azimuth 90 to the right
        axes.set_thetagrids(range(0, 360, 45), [f"{a}°" for a in range(0, 360, 45)], fontsize=8)
        axes.set_rlabel_position(22.5)
        axes.tick_params(axis="y", labelsize=7, colors="#666666")
        axes.set_title(title, pad=14)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), title="mean", title_fontsize=8.5, fontsize=8.5)
    figure.suptitle("voxel IoU by the azimuth of the input view, seen from above", fontsize=10, y=1.02)
    figure.tight_layout()
    return figure


def pairwise_iou(voxels: np.ndarray) -> np.ndarray:
    """Voxel IoU between all pairs of V shapes, bool [V, s, s, s]: float64 [V, V], NaN if both shapes are empty."""
    flat = voxels.reshape(len(voxels), -1).astype(np.float32)
    both = (flat @ flat.T).astype(np.float64)  # counts below 2^24 are exact
    sizes = flat.sum(axis=1, dtype=np.float64)
    union = sizes[:, None] + sizes[None] - both
    return np.divide(both, union, out=np.full_like(both, np.nan), where=union > 0)


@torch.no_grad()
def measure(method: Method, dataset: ViewDataset) -> tuple[np.ndarray, np.ndarray, float]:
    """Reconstruct every image of a data set: (IoUs with the truth, agreement, consistency).

    agreement float64 [M] is the mean voxel IoU of an image's shape with those from the object's other views, NaN
    without others; consistency the mean over objects of the mean over all pairs of views. Raises ValueError if the data
    set has no true voxels.
    """
    if dataset.voxels is None:
        raise ValueError(f"{dataset.category}, {dataset.split} has no true voxels to compare shapes with")
    ious, agreement, of_objects = np.full(len(dataset), np.nan), np.full(len(dataset), np.nan), []
    for number in np.unique(dataset.object_ids):
        samples = np.flatnonzero(dataset.object_ids == number)
        shapes = method.decode(method.encode(dataset.batch(torch.from_numpy(samples)).images))
        predicted = occupancy(shapes, dataset, "kato18").numpy()
        table = pairwise_iou(np.concatenate([dataset.voxels[number][None], predicted]))
        np.fill_diagonal(table, np.nan)
        ious[samples] = table[0, 1:]
        agreement[samples] = [mean(row) for row in table[1:, 1:]]
        of_objects.append(mean(agreement[samples]))
    return ious, agreement, mean(np.array(of_objects))


@_styled
def save_figure(figure: Figure, output: Path) -> list[Path]:
    """Write a figure as .png and as .svg, whichever ending `output` has; returns both paths."""
    output.parent.mkdir(parents=True, exist_ok=True)
    written = [output.with_suffix(".png"), output.with_suffix(".svg")]
    for path, options in zip(written, ({"dpi": 160}, {"metadata": {"Date": None}}), strict=True):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=path.suffix[1:], bbox_inches="tight", **options)
        writing.write_bytes(path, buffer.getvalue())
    return written
