"""The shape codes of a test set in the plane, coloured by the view: pose entanglement as one sees it (paper, t-SNE)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from learn3d.figures import plots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NEIGHBOURS = 5
FOLDS = 5
FEWEST = 10  # images below which neither an embedding nor a share says anything


@dataclass(frozen=True, eq=False)
class CodeMap:
    """The codes of M images laid out in the plane, and how much of the view is in them."""

    label: str  # name of the run
    points: np.ndarray  # float32 [M, 2]; distances within one map mean something, the axes do not
    azimuths_deg: np.ndarray  # float [M]: where the camera of each image stood
    accuracy: float | None  # share of images whose view class the codes give away, see `view_accuracy`
    chance: float | None  # the same without looking at the codes


def embed(codes: np.ndarray, *, seed: int = 0, perplexity: float = 30.0) -> np.ndarray:
    """Codes float [M, C] in the plane by t-SNE, float32 [M, 2]: the same for the same seed.

    The perplexity is lowered to a third of the codes where there are few. Raises ValueError below 10 codes.
    """
    from sklearn.manifold import TSNE

    if codes.ndim != 2 or len(codes) < FEWEST:
        raise ValueError(f"an embedding needs codes [M, C] of at least {FEWEST} images, got {list(codes.shape)}")
    tsne = TSNE(n_components=2, perplexity=min(perplexity, (len(codes) - 1) / 3), init="pca", random_state=seed)
    return tsne.fit_transform(np.ascontiguousarray(codes, np.float32))


def view_accuracy(codes: np.ndarray, view_ids: np.ndarray, object_ids: np.ndarray) -> tuple[float, float] | None:
    """How well the view class is read from a code: (share predicted right by 5 nearest neighbours, share by chance).

    Codes float [M, C]. Neighbours are sought among the images of other objects (5-fold cross-validation over objects):
    other views of the same object lie nearest in a code without pose, and would count as wrong answers. Chance is the
    most frequent view of the other objects. None with a single object or view.
    """
    from sklearn.dummy import DummyClassifier
    from sklearn.model_selection import GroupKFold
    from sklearn.neighbors import KNeighborsClassifier

    objects = len(np.unique(object_ids))
    if objects < 2 or len(np.unique(view_ids)) < 2:
        return None
    folds = list(GroupKFold(min(FOLDS, objects)).split(codes, view_ids, object_ids))
    neighbours = min(NEIGHBOURS, *(len(train) for train, _ in folds))
    shares = []
    for model in (KNeighborsClassifier(neighbours), DummyClassifier(strategy="most_frequent")):
        right = [model.fit(codes[a], view_ids[a]).predict(codes[b]) == view_ids[b] for a, b in folds]
        shares.append(float(np.concatenate(right).mean()))
    return shares[0], shares[1]


def map_codes(
    label: str,
    codes: np.ndarray,
    azimuths_deg: np.ndarray,
    view_ids: np.ndarray,
    object_ids: np.ndarray,
    *,
    seed: int = 0,
) -> CodeMap:
    """The map of one run, from codes [M, C] and what is known of each of the M images."""
    accuracy, chance = view_accuracy(codes, view_ids, object_ids) or (None, None)
    return CodeMap(label, embed(codes, seed=seed), azimuths_deg, accuracy, chance)


@plots.styled
def plot_maps(maps: Sequence[CodeMap]) -> Figure:
    """Code maps side by side (four in a row at most) with one wheel that says which colour is which azimuth."""
    from matplotlib.figure import Figure

    if not maps:
        raise ValueError("give at least one map of codes to draw")
    side, columns = 3.2, min(4, len(maps))
    rows = -(-len(maps) // columns)
    figure = Figure(figsize=(side * columns + 1.6, (side + 0.5) * rows))
    grid = figure.add_gridspec(rows, columns + 1, width_ratios=[side] * columns + [1.3], wspace=0.1, hspace=0.28)
    for index, code_map in enumerate(maps):
        _scatter(figure.add_subplot(grid[index // columns, index % columns]), code_map)
    _draw_wheel(figure.add_subplot(grid[:, -1], projection="polar"))
    return figure


def accuracy_text(code_map: CodeMap) -> str:
    """How much of the view the codes give away, in words."""
    if code_map.accuracy is None:
        return ""
    return f"view told from the code: {100 * code_map.accuracy:.0f} % (chance {100 * code_map.chance:.0f} %)"


def _scatter(axes: Axes, code_map: CodeMap) -> None:
    color = plots.cyclic_map()((code_map.azimuths_deg / 360.0) % 1.0)
    order = np.random.default_rng(0).permutation(len(color))  # else the last views would cover the others
    size = float(np.clip(7000 / len(color), 4, 16))
    axes.scatter(*code_map.points[order].T, c=color[order], s=size, linewidths=0, rasterized=len(color) > 3000)
    axes.set(xticks=[], yticks=[])
    axes.set_title(code_map.label, fontsize=11, pad=18)
    axes.text(0.5, 1.02, accuracy_text(code_map), transform=axes.transAxes, ha="center", va="bottom", fontsize=8)
    axes.margins(0.06)
    axes.spines[["top", "right"]].set_visible(True)
    axes.spines[:].set_color("#bbbbbb")


def _draw_wheel(axes: Axes) -> None:
    """Colours of the azimuths as seen from above: 0 at the bottom, where camera 0 stands, 90 at its right."""
    edges = np.linspace(0, 2 * np.pi, 361)
    middles = (edges[1:] + edges[:-1]) / 2
    axes.pcolormesh(edges, [0.58, 1.0], middles[None], cmap=plots.cyclic_map(), vmin=0, vmax=2 * np.pi, rasterized=True)
    axes.set_theta_zero_location("S")
    axes.set(ylim=(0, 1), yticks=[])
    axes.set_thetagrids([0, 90, 180, 270], ["0°", "90°", "180°", "270°"], fontsize=8)
    axes.tick_params(pad=-1)
    axes.grid(False)
    axes.spines["polar"].set_visible(False)
    axes.text(0, 0, "azimuth\nof the view", ha="center", va="center", fontsize=6.5)
