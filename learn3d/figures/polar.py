"""Voxel IoU by the azimuth of the input view, and how far the shapes from different views of one object agree.

A model whose codes carry the pose reconstructs some views worse than others, and other shapes from other views of the
same object; a pose-invariant one draws two nearly round lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.conventions import Definition
from learn3d.data.dataset import ViewDataset
from learn3d.evaluation import occupancy
from learn3d.figures import plots
from learn3d.methods import Method
from learn3d.pictures.surfaces import azimuths_deg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_DIRECTIONS = 36  # azimuths that are drawn one by one; more are gathered in sectors
SECTORS = 24


@dataclass(frozen=True, eq=False)
class ViewProfile:
    """The figures of one run by azimuth. NaN where a direction has no image with a defined value."""

    label: str
    azimuths_deg: np.ndarray  # float64 [D], ascending in 0 .. 360
    iou: np.ndarray  # float64 [D]: mean voxel IoU with the truth over the images of each direction
    agreement: np.ndarray  # float64 [D]: mean voxel IoU with the shapes from the object's other views
    mean_iou: float  # over all images
    consistency: float  # mean over objects of the mean voxel IoU over all pairs of their views; NaN: single views

    def to_json(self) -> dict[str, Any]:
        """Plain values; NaN becomes None."""
        rows = {name: [_plain(x) for x in getattr(self, name)] for name in ("azimuths_deg", "iou", "agreement")}
        return {"label": self.label, **rows, "mean_iou": _plain(self.mean_iou), "consistency": _plain(self.consistency)}


def directions(azimuths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which direction each image counts to: (int64 [M] in 0 .. D-1, the directions' azimuths float64 [D]).

    Up to 36 different azimuths (to 0.01 degrees) are directions of their own; more are gathered in 24 sectors of 15
    degrees, centred at 0, 15, 30 ...
    """
    rounded = np.round(np.asarray(azimuths, np.float64) % 360.0, 2) % 360.0
    distinct, ids = np.unique(rounded, return_inverse=True)
    if len(distinct) <= MOST_DIRECTIONS:
        return ids.astype(np.int64), distinct
    width = 360.0 / SECTORS
    return (np.round(rounded / width) % SECTORS).astype(np.int64), np.arange(SECTORS) * width


def agreements(voxels: np.ndarray) -> np.ndarray:
    """Voxel IoU between all pairs of V predicted shapes, bool [V, s, s, s]: float64 [V, V], NaN on the diagonal.

    NaN, too, where both shapes are empty.
    """
    flat = voxels.reshape(len(voxels), -1).astype(np.float32)
    both = (flat @ flat.T).astype(np.float64)  # counts below 2^24 are exact
    sizes = flat.sum(axis=1, dtype=np.float64)
    union = sizes[:, None] + sizes[None] - both
    with np.errstate(invalid="ignore"):
        iou = both / np.where(union > 0, union, np.nan)
    np.fill_diagonal(iou, np.nan)
    return iou


def profile(
    label: str, azimuths: np.ndarray, ious: np.ndarray, agreement: np.ndarray, object_ids: np.ndarray
) -> ViewProfile:
    """Gather per-image figures by direction.

    azimuths (degrees), ious, agreement float [M]: of every image where it was seen from, the IoU of its shape with the
    truth, and the mean IoU with the shapes from the object's other views (NaN: none). The mean of the latter over the
    views of an object is the mean over all its pairs, so `consistency` is the mean over objects of these means.
    """
    ids, middles = directions(azimuths)
    per_object = [_mean(agreement[object_ids == k]) for k in np.unique(object_ids)]
    return ViewProfile(
        label,
        middles,
        np.array([_mean(ious[ids == d]) for d in range(len(middles))]),
        np.array([_mean(agreement[ids == d]) for d in range(len(middles))]),
        _mean(ious),
        _mean(np.array(per_object)),
    )


@torch.no_grad()
def measure(
    label: str, method: Method, dataset: ViewDataset, definition: Definition = "kato18", *, batch_size: int = 256
) -> ViewProfile:
    """Reconstruct every image of a data set and compare the shapes with the truth and with each other.

    Raises ValueError where the data set has no true voxels.
    """
    if dataset.voxels is None:
        raise ValueError(f"{dataset.category}, {dataset.split} has no true voxels to compare shapes with")
    ious, agreement = np.full(len(dataset), np.nan), np.full(len(dataset), np.nan)
    for samples in _whole_objects(dataset.object_ids, batch_size):
        shapes = [method.decode(method.encode(dataset.batch(part).images)) for part in samples.split(batch_size)]
        predicted = torch.cat([occupancy(shape, dataset, definition) for shape in shapes])
        rows, objects = samples.numpy(), dataset.object_ids[samples.numpy()]
        ious[rows] = nmr.metrics.voxel_iou(predicted, torch.from_numpy(dataset.voxels[objects])).numpy()
        for number in np.unique(objects):
            views = objects == number
            agreement[rows[views]] = _row_means(agreements(predicted[torch.from_numpy(views)].numpy()))
    return profile(label, azimuths_deg(dataset.poses).numpy(), ious, agreement, dataset.object_ids)


def _whole_objects(object_ids: np.ndarray, size: int) -> list[Tensor]:
    """All samples, int64, in parts of about `size` that do not cut an object."""
    order = np.argsort(object_ids, kind="stable")
    starts = np.flatnonzero(np.diff(object_ids[order], prepend=-1))
    cuts = [start for k, start in enumerate(starts[1:]) if start // size != starts[k] // size]
    return [torch.from_numpy(part) for part in np.split(order, cuts)]


def _row_means(pairs: np.ndarray) -> np.ndarray:
    return np.array([_mean(row) for row in pairs])


@plots.styled
def plot_profiles(profiles: Sequence[ViewProfile]) -> Figure:
    """IoU with the truth and agreement among the views by where the camera stood, seen from above.

    The second plot is left out where no object was seen from two sides.
    """
    from matplotlib.figure import Figure

    if not profiles:
        raise ValueError("give at least one run to draw")
    panels = [("iou", "mean_iou", "with the truth")]
    if any(not np.isnan(p.consistency) for p in profiles):
        panels.append(("agreement", "consistency", "among the shapes from different views of an object"))
    figure = Figure(figsize=(4.2 * len(panels), 4.6 + 0.2 * len(profiles)))
    for k, (name, mean, title) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, len(panels), k, projection="polar")
        for index, p in enumerate(profiles):
            theta = np.deg2rad(np.append(p.azimuths_deg, p.azimuths_deg[:1]))
            radius = np.append(getattr(p, name), getattr(p, name)[:1])
            label = f"{p.label}: {getattr(p, mean):.3f}"
            axes.plot(theta, radius, marker="o", markersize=2.5, label=label, **plots.line_style(index))
        axes.set_ylim(0, _round_up(max(_largest(getattr(p, name)) for p in profiles)))
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


def _largest(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.max()) if len(known) else 0.0


def _round_up(value: float) -> float:
    return float(np.clip(np.ceil(value * 10 + 0.2) / 10, 0.1, 1.0))


def _mean(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def _plain(value: float) -> float | None:
    return None if np.isnan(value) else float(value)
