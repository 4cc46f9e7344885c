"""The paper's t-SNE maps of shape codes, coloured by the view."""

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import skimage.color
import torch
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from sklearn.dummy import DummyClassifier
from sklearn.manifold import TSNE
from sklearn.model_selection import GroupKFold, cross_val_predict
from sklearn.neighbors import KNeighborsClassifier

from learn3d.evaluation import spread_samples
from learn3d.files import writing
from learn3d.pictures import azimuths_deg
from learn3d.studio.tables.trained_models import TrainedModel

MOST_CODES, FEWEST_CODES = 2000, 10  # images in a map; one of fewer means nothing
_styled = (
    mpl.rc_context(  # a decorator: matplotlib's settings change in the decorated functions alone
        {
            "font.size": 9,
            "axes.titlesize": 9.5,
            "text.parse_math": False,  # a label may have dollar signs
            "svg.hashsalt": "learn3d",  # the same figure gives the same file
            "svg.fonttype": "none",
        }
    )
)


@_styled
@torch.no_grad()
def draw_tsne(runs: Sequence[TrainedModel]) -> Figure:
    """The shape codes of up to 2,000 images by t-SNE: a map for each run, coloured by the azimuths of the cameras.

    Above each map is how often the view is predicted from a code; a colour wheel is the legend.
    Raises ValueError for data of fewer than 10 images or without poses.
    """
    columns = min(4, len(runs))
    rows = -(-len(runs) // columns)
    figure = Figure(figsize=(3.2 * columns + 1.6, 3.7 * rows))
    grid = figure.add_gridspec(
        rows, columns + 1, width_ratios=[3.2] * columns + [1.3], wspace=0.1, hspace=0.28
    )
    wheel = ListedColormap(cyclic_colors())
    for index, run in enumerate(runs):
        dataset = run.dataset
        samples = spread_samples(dataset.object_ids, dataset.view_ids, MOST_CODES)
        batches = [
            run.method.encode(dataset.batch(part).images).float().cpu()
            for part in samples.split(256)
        ]
        codes = torch.cat(batches).numpy()
        points = embed(codes)
        color = wheel(azimuths_deg(dataset.poses)[samples].numpy() / 360 % 1.0)
        # so that no view covers all others
        order = np.random.default_rng(0).permutation(len(points))
        size = float(np.clip(7000 / len(points), 4, 16))
        axes = figure.add_subplot(grid[index // columns, index % columns])
        axes.scatter(*points[order].T, c=color[order], s=size, linewidths=0)
        axes.set(xticks=[], yticks=[])
        axes.set_title(run.label, fontsize=11, pad=18)
        accuracy = view_accuracy(
            codes, dataset.view_ids[samples.numpy()], dataset.object_ids[samples.numpy()]
        )
        caption = (
            "view told from the code: {:.0%} (chance {:.0%})".format(*accuracy) if accuracy else ""
        )
        axes.text(
            0.5,
            1.02,
            caption.replace("%", " %"),
            transform=axes.transAxes,
            ha="center",
            va="bottom",
            fontsize=8,
        )
        axes.margins(0.06)
        axes.spines[:].set_color("#bbbbbb")
    axes = figure.add_subplot(grid[:, -1], projection="polar")
    edges = np.linspace(0, 2 * np.pi, 361)
    middles = (edges[None, 1:] + edges[None, :-1]) / 2
    axes.pcolormesh(
        edges, [0.58, 1.0], middles, cmap=wheel, vmin=0, vmax=2 * np.pi, rasterized=True
    )
    # seen from above: the camera of azimuth 0 is below, that of 90 to the right
    axes.set_theta_zero_location("S")
    axes.set(ylim=(0, 1), yticks=[])
    axes.set_thetagrids([0, 90, 180, 270], ["0°", "90°", "180°", "270°"], fontsize=8)
    axes.tick_params(pad=-1)
    axes.grid(False)
    axes.spines["polar"].set_visible(False)
    axes.text(0, 0, "azimuth\nof the view", ha="center", va="center", fontsize=6.5)
    return figure


def embed(codes: np.ndarray) -> np.ndarray:
    """Embed codes float [M, C] in the plane by t-SNE, float32 [M, 2]. The same codes give the same points."""
    if len(codes) < FEWEST_CODES:
        raise ValueError(
            f"an embedding needs codes [M, C] of at least {FEWEST_CODES} images, got {list(codes.shape)}"
        )
    tsne = TSNE(
        n_components=2, perplexity=min(30.0, (len(codes) - 1) / 3), init="pca", random_state=0
    )
    return tsne.fit_transform(np.ascontiguousarray(codes, np.float32))


def view_accuracy(
    codes: np.ndarray, view_ids: np.ndarray, object_ids: np.ndarray
) -> tuple[float, float] | None:
    """Accuracies of predicting the view class from codes float [M, C]: by 5 nearest neighbours, and by chance.

    5-fold cross-validation over objects: neighbours are images of other objects. In a code
    without pose the nearest neighbours are other views of the same object, which would count as
    errors. Chance always predicts the most frequent view. None if there is a single object or
    view.
    """
    objects = len(np.unique(object_ids))
    if objects < 2 or len(np.unique(view_ids)) < 2:
        return None
    folds = list(GroupKFold(min(5, objects)).split(codes, view_ids, object_ids))
    neighbours = min(5, *(len(train) for train, _ in folds))
    models = KNeighborsClassifier(neighbours), DummyClassifier(strategy="most_frequent")
    return tuple(
        np.mean(cross_val_predict(model, codes, view_ids, cv=folds) == view_ids) for model in models
    )


def cyclic_colors(count: int = 256) -> np.ndarray:
    """A cyclic colour map, float [count, 3] in [0, 1], that is safe for every kind of colour vision.

    A circle in CIE Lab through lightness and the blue-yellow axis: dark violet, blue, light
    green, brown. Opposite directions differ clearly, and no colour is too light for a white page.
    """
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    lab = np.stack(
        [54 - 28 * np.cos(angle), 24 * np.cos(angle) - 16 * np.sin(angle), -50 * np.sin(angle)],
        axis=1,
    )
    return skimage.color.lab2rgb(lab[None])[0].clip(0, 1)


@_styled
def save_tsne(runs: Sequence[TrainedModel], output: Path) -> list[Path]:
    """Save `draw_tsne` as .png and as .svg, whichever ending `output` has; returns both paths."""
    figure = draw_tsne(runs)
    output.parent.mkdir(parents=True, exist_ok=True)
    written = [output.with_suffix(".png"), output.with_suffix(".svg")]
    for path, options in zip(written, ({"dpi": 160}, {"metadata": {"Date": None}}), strict=True):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=path.suffix[1:], bbox_inches="tight", **options)
        writing.write_bytes(path, buffer.getvalue())
    return written
