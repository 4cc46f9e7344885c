"""Voxel IoU, distance between surfaces and pose invariance (MMD) of a trained method on one split of a data set."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.batch import Batch
from learn3d.data.conventions import Definition
from learn3d.data.dataset import ViewDataset
from learn3d.distributed.process_group import SINGLE_PROCESS, ProcessGroup
from learn3d.losses import mmd_from_distances
from learn3d.methods import Grids, Meshes, Method
from learn3d.methods.surfaces import grid_surface
from learn3d.pictures.surfaces import Surface

#: What brings the predicted shapes of a batch to the true ones before they are compared; see `evaluate`.
Align = Callable[[Meshes | Grids, Batch, ViewDataset], Meshes | Grids]

CODES_PER_VIEW = 512
SURFACE_POINTS = 2000
F_SCORE_DISTANCE = 0.05  # units of the object frame, where the longest side is 1 (Pascal3D+: up to 2)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result for one class: a value per image, and the MMDs (None when fewer than two views have codes)."""

    object_ids: Tensor  # int64 [M]
    view_ids: Tensor  # int64 [M]
    ious: dict[Definition, Tensor]  # [M] per voxeliser; NaN where prediction and truth are empty; {} without truth
    precision: Tensor | None  # float64 [M]: part of the predicted voxels that is true, by the first voxeliser
    recall: Tensor | None  # float64 [M]: part of the true voxels that is predicted; both NaN where there are none
    hollow: int  # meshes that reach beyond the grid, where the first voxeliser finds no inside
    chamfer_l1: Tensor | None  # float [M], NaN where a surface is empty; None when not asked for or without truth
    f_score: Tensor | None  # float [M], 0 where the prediction alone is empty; likewise
    silhouette_iou: Tensor | None  # float [M], where there are no voxels and shapes are meshes
    mmd: float | None
    mmd_paper: float | None

    @property
    def images(self) -> int:
        """Number of images."""
        return len(self.object_ids)

    @property
    def mmd_codes(self) -> int:
        """Codes of each view that the MMDs compare; the fewer, the larger the MMDs come out (bias of 1 / codes)."""
        return codes_per_view(self.view_ids)

    @property
    def without_mmd(self) -> str:
        """Why there is no MMD; empty where there is one."""
        if self.mmd_codes:
            return ""
        views = len(self.view_ids.unique())
        return f"no MMD: it takes two images of each of two views, and these are {self.images} images of {views} views"

    @property
    def undefined(self) -> int:
        """Images whose prediction and truth are both empty; they are left out of the mean."""
        ious = next(iter(self.ious.values())) if self.ious else self.silhouette_iou
        return 0 if ious is None else int(ious.isnan().sum())

    @property
    def without_distance(self) -> int | None:
        """Images whose predicted (or true) surface is empty; they are left out of the mean Chamfer distance."""
        return None if self.chamfer_l1 is None else int(self.chamfer_l1.isnan().sum())

    @property
    def voxel_iou(self) -> float | None:
        """Mean IoU over the images by the first voxeliser; None when it is defined for no image."""
        return _mean(next(iter(self.ious.values()))) if self.ious else None

    @property
    def chosen_by(self) -> tuple[str, float | None]:
        """Name and value of what networks are chosen by: the voxel IoU, or that of silhouettes where it is all."""
        if self.silhouette_iou is not None:
            return "silhouette IoU", _mean(self.silhouette_iou)
        return "voxel IoU", self.voxel_iou

    def summary(self) -> dict[str, Any]:
        """Means as plain values; what was not computed is None."""
        return {
            "voxel_iou": self.voxel_iou,
            **{f"voxel_iou_{name}": _mean(values) for name, values in self.ious.items()},
            "precision": _mean(self.precision),
            "recall": _mean(self.recall),
            "chamfer_l1": _mean(self.chamfer_l1),
            "f_score": _mean(self.f_score),
            "silhouette_iou": _mean(self.silhouette_iou),
            "mmd": self.mmd,
            "mmd_paper": self.mmd_paper,
            "mmd_codes": self.mmd_codes,
            "images": self.images,
            "undefined": self.undefined,
            "hollow": self.hollow,
            "without_distance": self.without_distance,
        }


@torch.no_grad()
def evaluate(
    method: Method,
    dataset: ViewDataset,
    *,
    definitions: Sequence[Definition] = ("kato18",),
    max_images: int | None = None,
    paper_mmd: bool = False,
    surfaces: bool = False,
    align: Align | None = None,
    batch_size: int = 256,
) -> Evaluation:
    """Voxel IoU of every image of a split, and the mean MMD over all pairs of view classes.

    Every image is encoded, its shape voxelised in the data set's convention and compared with the object's voxels, by
    each voxeliser of `definitions`. With `max_images` only that many images are used, always the same ones: see
    `spread_samples`. `paper_mmd` also computes the MMD as the paper prints it. `surfaces` also compares points on the
    surfaces, in units of the object frame: Chamfer-L1 and F-score at a distance of 0.05, 2,000 points of each;
    where the data set has no points, the truth is the surface of its voxels, which limits them to about 1/32.

    Where the data set has no voxels, meshes are seen by the camera of another image of the object instead (of the only
    one where there is no other) and compared with that image's mask: the IoU of silhouettes. Without voxels and poses
    there is nothing to compare with.

    `align` is for methods whose shapes may stand otherwise than the true ones: a function of the predicted shapes, the
    batch and the data set that returns the shapes to be compared.

    Where several processes train the method, all of them call this; they share the work, and all return the result that
    one process gives with these networks. Raises ValueError for `surfaces` there: they are measured in one process.
    """
    group = method.group
    if surfaces and group.world_size > 1:
        raise ValueError("surfaces are measured in one process; evaluate the run when it has ended")
    count = len(dataset) if max_images is None else min(max_images, len(dataset))
    generator = torch.Generator().manual_seed(0)
    truth = _true_surfaces(dataset, generator) if surfaces else None
    ious: dict[Definition, list[Tensor]] = {name: [] for name in definitions if dataset.voxels is not None}
    codes, distances, silhouettes, overlaps = [], [], [], []
    others = _other_images(dataset.object_ids) if dataset.voxels is None else None
    samples = spread_samples(dataset.object_ids, dataset.view_ids, count)
    view_ids = torch.from_numpy(dataset.view_ids[samples.numpy()]).to(torch.int64)
    compared = _first_of_each_view(view_ids)
    chunks = samples.split(batch_size)
    rows = torch.arange(count).split(batch_size)[group.rank :: group.world_size]
    was_training = method.training
    method.set_training(False)
    try:
        for numbers, chosen in zip(rows, chunks[group.rank :: group.world_size], strict=True):
            batch = dataset.batch(chosen)
            code = method.encode(batch.images)
            shapes = method.decode(code)
            if align is not None:
                shapes = align(shapes, batch, dataset)
            for number, name in enumerate(ious):
                filled = occupancy(shapes, dataset, name)
                ious[name].append(nmr.metrics.voxel_iou(filled, batch.voxels))
                if number == 0:
                    precision, recall = nmr.metrics.voxel_precision_recall(filled, batch.voxels)
                    hollow = torch.zeros(len(filled), dtype=torch.bool)
                    if isinstance(shapes, Meshes):
                        hollow = dataset.convention.exceeds_grid(shapes.vertices, name)
                    overlaps.append(torch.stack([precision, recall, hollow.to(precision)], dim=1))
            if truth is not None:
                points = [_sample(surface, generator) for surface in shapes.surfaces()]
                distances += [_compare(a, truth[b]) for a, b in zip(points, batch.object_ids.tolist(), strict=True)]
            if dataset.voxels is None and dataset.poses is not None and isinstance(shapes, Meshes):
                silhouettes.append(_silhouette_ious(shapes, dataset.batch(others[chosen])))
            codes.append(code.float().cpu()[compared[numbers]])
    finally:
        method.set_training(was_training)
    forms = ("released", "paper") if paper_mmd else ("released",)
    own = torch.cat(rows) if rows else torch.empty(0, dtype=torch.int64)
    place = (compared.cumsum(0) - 1)[own[compared[own]]]  # of this process's codes among all that are compared
    all_codes = group.all_gather(codes, place, int(compared.sum()))
    means = mean_mmd(all_codes, view_ids[compared], forms=forms, group=group)
    chamfer, f_score = torch.tensor(distances).T if distances else (None, None)
    seen = group.any(bool(silhouettes))
    precision, recall, hollow = group.all_gather(overlaps, own, count).T if ious else (None, None, torch.zeros(0))
    return Evaluation(
        object_ids=torch.from_numpy(dataset.object_ids[samples.numpy()]).to(torch.int64),
        view_ids=view_ids,
        ious={name: group.all_gather(values, own, count) for name, values in ious.items()},
        precision=precision,
        recall=recall,
        hollow=int(hollow.sum()),
        chamfer_l1=chamfer,
        f_score=f_score,
        silhouette_iou=group.all_gather(silhouettes, own, count) if seen else None,
        mmd=means.get("released"),
        mmd_paper=means.get("paper"),
    )


def occupancy(shapes: Meshes | Grids, dataset: ViewDataset, definition: Definition) -> Tensor:
    """Predictions as bool [B, 32, 32, 32] in the data set's voxel axes. A voxeliser makes no difference to grids."""
    if isinstance(shapes, Meshes):
        return dataset.voxelize(shapes.vertices, shapes.faces, definition)
    if dataset.convention.box != 1.0:
        raise ValueError(f"grids over the box [-0.5, 0.5] cannot be compared with {dataset.convention.name} voxels")
    return dataset.convention.to_axes(shapes.occupied(dataset.voxels.shape[-1]))


def _other_images(object_ids: np.ndarray) -> Tensor:
    """For each sample another one of its object, int64 [M]: a quarter of the object's images further on.

    That is a quarter turn where the views go around the object: half of one would show the same outline mirrored.
    """
    order = np.argsort(object_ids, kind="stable")
    others = np.empty_like(order)
    for group in np.split(order, np.flatnonzero(np.diff(object_ids[order])) + 1):
        others[group] = np.roll(group, -max(1, len(group) // 4))
    return torch.from_numpy(others)


def _silhouette_ious(shapes: Meshes, batch: Batch) -> Tensor:
    """IoU [B] of silhouettes at the cameras of a batch with its masks: sum of the smaller over sum of the larger value.

    1 where they are equal, soft borders included; NaN where both are empty.
    """
    size = batch.masks.shape[-1]
    seen = nmr.render_silhouette(shapes.vertices, shapes.faces, batch.cameras, image_size=size).flatten(1)
    masks = batch.masks.flatten(1)
    return torch.minimum(seen, masks).sum(1) / torch.maximum(seen, masks).sum(1)


def _first_of_each_view(view_ids: Tensor) -> Tensor:
    """Which images are the first 512 of their view, bool [M]: `mean_mmd` compares the codes of these alone."""
    order = view_ids.argsort(stable=True)
    counts = view_ids.unique(return_counts=True)[1]
    begin = counts.cumsum(0) - counts
    first = torch.empty(len(view_ids), dtype=torch.bool)
    first[order] = torch.arange(len(view_ids)) - begin.repeat_interleave(counts) < CODES_PER_VIEW
    return first


def spread_samples(object_ids: np.ndarray, view_ids: np.ndarray, count: int) -> Tensor:
    """`count` different samples, int64 [count], ascending; a function of its arguments alone.

    Every view is among them about as often as any other, and so is every object: samples are taken one after the other
    in a shuffled order, each time from those whose view and object have been taken least.
    """
    total = len(object_ids)
    if count >= total:
        return torch.arange(total)
    order = np.random.default_rng(0).permutation(total)
    views_taken, objects_taken = np.zeros(view_ids.max() + 1, int), np.zeros(object_ids.max() + 1, int)
    left = np.ones(total, bool)
    chosen = np.empty(count, np.int64)
    views, objects = view_ids[order], object_ids[order]
    for i in range(count):
        load = views_taken[views] + objects_taken[objects] + np.where(left, 0, 2 * total)
        best = int(load.argmin())
        left[best] = False
        views_taken[views[best]] += 1
        objects_taken[objects[best]] += 1
        chosen[i] = order[best]
    return torch.from_numpy(np.sort(chosen))


def mean_mmd(
    codes: Tensor,
    view_ids: Tensor,
    *,
    per_view: int = CODES_PER_VIEW,
    forms: tuple[Literal["released", "paper"], ...] = ("released",),
    group: ProcessGroup = SINGLE_PROCESS,
) -> dict[str, float]:
    """Mean MMD over all pairs of views (276 for 24) between the codes [N,C] of their images; {} for a single view.

    Of each view the first `per_view` codes count; all views use as many as the poorest one has. Views with one code are
    left out: between two single codes the MMD is a constant (6.19), whatever they are. Distances within a view are
    computed once, not once per pair. Several processes share the pairs.
    """
    of_views = [codes[view_ids == view] for view in view_ids.unique()]
    size = codes_per_view(view_ids, per_view=per_view)
    if size == 0:
        return {}
    groups = [of_view[:size].double() for of_view in of_views if len(of_view) > 1]
    norms = [codes_of_view.square().sum(1) for codes_of_view in groups]

    def distances(i: int, j: int) -> Tensor:
        squared = torch.addmm(norms[j].expand(size, size), groups[i], groups[j].T, alpha=-2)
        return (squared + norms[i][:, None]).clamp_min_(0).float()

    within = [distances(i, i) for i in range(len(groups))]
    pairs = list(itertools.combinations(range(len(groups)), 2))
    own = torch.arange(len(pairs))[group.rank :: group.world_size]
    values: dict[str, list[Tensor]] = {form: [] for form in forms}
    for i, j in pairs[group.rank :: group.world_size]:
        between = distances(i, j)
        for form in forms:
            values[form].append(mmd_from_distances(within[i], within[j], between, form)[None])
    of_pairs = {form: group.all_gather(parts, own, len(pairs)) for form, parts in values.items()}
    return {form: sum(of_pairs[form].tolist()) / len(pairs) for form in forms}


def codes_per_view(view_ids: Tensor, *, per_view: int = CODES_PER_VIEW) -> int:
    """How many codes of each view `mean_mmd` uses: as many as the poorest view of several codes has; 0 for no MMD."""
    counts = view_ids.unique(return_counts=True)[1]
    counts = counts[counts > 1]
    return min(per_view, int(counts.min())) if len(counts) > 1 else 0


def _mean(values: Tensor | None) -> float | None:
    """Mean of what is defined."""
    if values is None or bool(values.isnan().all()):
        return None
    return float(values.nanmean())


def _true_surfaces(dataset: ViewDataset, generator: torch.Generator) -> list[Tensor] | None:
    """Points [P, 3] on the true surface of every object, in the object frame; None where nothing is known."""
    parts = np.split(np.arange(dataset.num_objects), range(256, dataset.num_objects, 256))
    if dataset.points is not None:
        return [points.float() for part in parts for points in torch.from_numpy(dataset.points[part])]
    if dataset.voxels is None:
        return None
    grids = (grid for part in parts for grid in dataset.convention.to_object(torch.from_numpy(dataset.voxels[part])))
    return [_sample(grid_surface(grid.float(), box=dataset.convention.box), generator) for grid in grids]


def _sample(surface: Surface, generator: torch.Generator) -> Tensor:
    """Points [P, 3] on a surface; [0, 3] if it is empty."""
    if len(surface.faces) == 0:
        return torch.empty(0, 3)
    return nmr.metrics.sample_surface(surface.vertices, surface.faces, SURFACE_POINTS, generator=generator).points


def _compare(a: Tensor, b: Tensor) -> tuple[float, float]:
    """(Chamfer-L1, F-score) of two sets of points. A set that is empty has no distance (NaN), and where the other is
    not, nothing of either is found: an F-score of 0."""
    if not (len(a) and len(b)):
        return math.nan, 0.0 if len(a) or len(b) else math.nan
    return float(nmr.metrics.chamfer_distance(a, b, form="l1")), float(nmr.metrics.f_score(a, b, F_SCORE_DISTANCE))
