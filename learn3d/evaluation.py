"""Voxel IoU, distance between surfaces and pose invariance (MMD) of a trained method on one split of a data set."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.batch import Batch
from learn3d.data.conventions import Definition
from learn3d.data.dataset import ViewDataset
from learn3d.losses import mmd_from_distances
from learn3d.methods import Grids, Meshes, Method
from learn3d.methods.surfaces import grid_surface
from learn3d.pictures.surfaces import Surface

#: A function that brings the predicted shapes of a batch to the true ones before they are compared; see `evaluate`.
Align = Callable[[Meshes | Grids, Batch, ViewDataset], Meshes | Grids]

CODES_PER_VIEW = 512
SURFACE_POINTS = 2000
F_SCORE_DISTANCE = 0.05  # units of the object frame: objects are 1 long (Pascal3D+: up to 2)

#: Figures of each image.
MEASURED = (
    "voxel_iou",  # kato18; NaN if prediction and truth are empty
    "voxel_iou_kato19",
    "precision",  # part of the predicted voxels that is true (kato18)
    "recall",  # part of the true voxels that is predicted
    "hollow",  # 1 if the mesh reaches beyond the grid, so that kato18 finds no inside
    "chamfer_l1",  # NaN if a surface is empty
    "f_score",  # 0 if the prediction alone is empty
    "silhouette_iou",  # with the mask of another image of the object
)
NO_MMD = "no MMD: it takes two images of each of two views"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Figures of each image of one class, and their means."""

    object_ids: Tensor  # int64 [M]
    view_ids: Tensor  # int64 [M]
    values: dict[str, Tensor]  # float64 [M] for each name of `MEASURED`; NaN if undefined or not asked for
    means: dict[str, float]  # over the images that have a value, and "mmd", "mmd_paper"; no entry if undefined

    @property
    def voxel_iou(self) -> float | None:
        """Mean voxel IoU (kato18)."""
        return self.means.get("voxel_iou")

    @property
    def mmd(self) -> float | None:
        """MMD by the published code."""
        return self.means.get("mmd")

    @property
    def main_metric(self) -> Literal["voxel_iou", "silhouette_iou"]:
        """Name of the metric that is shown first: the IoU of silhouettes if no voxels are known."""
        return "silhouette_iou" if "voxel_iou" not in self.means and "silhouette_iou" in self.means else "voxel_iou"

    @property
    def selection_metric(self) -> Literal["voxel_iou", "silhouette_iou"]:
        """Name of the metric that selects the best networks: the IoU of silhouettes at novel views, if it is known. It
        needs no 3D data.
        """
        return "silhouette_iou" if "silhouette_iou" in self.means else "voxel_iou"


@torch.no_grad()
def evaluate(
    method: Method,
    dataset: ViewDataset,
    *,
    max_images: int | None = None,
    detailed: bool = False,
    align: Align | None = None,
    batch_size: int = 256,
) -> Evaluation:
    """Measure the shape of every image of a split, and the mean MMD over all pairs of view classes.

    Shapes are voxelised in the data set's convention and compared with the object's voxels. Meshes are also seen by the
    camera of another image of the object and compared with that image's mask: the IoU of silhouettes. If there are no
    other images, the image itself takes their place, but only without voxels. Without poses silhouettes are unknown.

    max_images: use only that many images, always the same ones (see `spread_samples`).
    detailed: add the voxel IoU by kato19, the MMD as the paper prints it, and Chamfer-L1 and F-score between 2,000
    points on each surface. If the data set has no points, the truth is the surface of its voxels, which limits
    distances to about 1/32.
    align: a function of the predicted shapes, the batch and the data set that returns the shapes to be compared, for
    methods whose shapes may be turned or moved against the true ones.
    """
    count = len(dataset) if max_images is None else min(max_images, len(dataset))
    samples = spread_samples(dataset.object_ids, dataset.view_ids, count)
    others = _other_images(dataset.object_ids)
    novel_views = bool((others != torch.arange(len(others))).any())
    generator = torch.Generator().manual_seed(0)
    surfaces = _true_surfaces(dataset, generator) if detailed else None
    codes, values = [], []
    was_training = method.training
    method.set_training(False)
    try:
        for chosen in samples.split(batch_size):
            batch = dataset.batch(chosen)
            code = method.encode(batch.images)
            shapes = method.decode(code)
            if align is not None:
                shapes = align(shapes, batch, dataset)
            measured = {}
            if dataset.voxels is not None:
                measured = _compare_voxels(shapes, batch, dataset, detailed)
            if (novel_views or not measured) and dataset.poses is not None and isinstance(shapes, Meshes):
                measured |= _compare_silhouettes(shapes, dataset.batch(others[chosen]))
            if surfaces is not None:
                measured |= _compare_surfaces(shapes, [surfaces[k] for k in batch.object_ids.tolist()], generator)
            unknown = torch.full((len(chosen),), math.nan)
            values.append(torch.stack([measured.get(name, unknown).double() for name in MEASURED], dim=1))
            codes.append(code.float().cpu())
    finally:
        method.set_training(was_training)
    object_ids, view_ids = (torch.from_numpy(ids[samples.numpy()]) for ids in (dataset.object_ids, dataset.view_ids))
    figures = dict(zip(MEASURED, torch.cat(values).T, strict=True))
    means = {name: float(v.nanmean()) for name, v in figures.items() if not v.isnan().all()}
    mmds = mean_mmd(torch.cat(codes).double(), view_ids, ("mmd", "mmd_paper") if detailed else ("mmd",))
    return Evaluation(object_ids.long(), view_ids.long(), figures, means | mmds)


def occupancy(shapes: Meshes | Grids, dataset: ViewDataset, definition: Definition) -> Tensor:
    """Predictions as bool [B, 32, 32, 32] in the data set's voxel axes. A voxeliser makes no difference to grids."""
    if isinstance(shapes, Meshes):
        return dataset.voxelize(shapes.vertices, shapes.faces, definition)
    if dataset.convention.cube_side != 1.0:
        raise ValueError(f"grids over the box [-0.5, 0.5] cannot be compared with {dataset.convention.name} voxels")
    return dataset.convention.to_axes(shapes.occupied(dataset.voxels.shape[-1]))


def _compare_voxels(shapes: Meshes | Grids, batch: Batch, dataset: ViewDataset, detailed: bool) -> dict[str, Tensor]:
    grid = occupancy(shapes, dataset, "kato18")
    precision, recall = nmr.metrics.voxel_precision_recall(grid, batch.voxels)
    found = {"voxel_iou": nmr.metrics.voxel_iou(grid, batch.voxels), "precision": precision, "recall": recall}
    if detailed:
        found["voxel_iou_kato19"] = nmr.metrics.voxel_iou(occupancy(shapes, dataset, "kato19"), batch.voxels)
    is_mesh = isinstance(shapes, Meshes)
    found["hollow"] = dataset.convention.exceeds_grid(shapes.vertices, "kato18") if is_mesh else torch.zeros(len(grid))
    return found


def _compare_silhouettes(shapes: Meshes, batch: Batch) -> dict[str, Tensor]:
    """IoU of silhouettes at the cameras of a batch with its masks: sum of the smaller over sum of the larger value.

    1 if they are equal, soft borders included; NaN if both are empty.
    """
    size = batch.masks.shape[-1]
    seen = nmr.render_silhouette(shapes.vertices, shapes.faces, batch.cameras, image_size=size).flatten(1)
    masks = batch.masks.flatten(1)
    return {"silhouette_iou": torch.minimum(seen, masks).sum(1) / torch.maximum(seen, masks).sum(1)}


def _compare_surfaces(shapes: Meshes | Grids, truth: list[Tensor], generator: torch.Generator) -> dict[str, Tensor]:
    """Chamfer-L1 and F-score with the true points [P, 3] of each object.

    An empty surface has no distance (NaN). If only one of the two is empty, the F-score is 0.
    """
    found = []
    for surface, theirs in zip(shapes.surfaces(), truth, strict=True):
        ours = _sample(surface, generator)
        if len(ours) and len(theirs):
            distance = nmr.metrics.chamfer_distance(ours, theirs, form="l1")
            found.append((float(distance), float(nmr.metrics.f_score(ours, theirs, F_SCORE_DISTANCE))))
        else:
            found.append((math.nan, 0.0 if len(ours) or len(theirs) else math.nan))
    chamfer, f_score = torch.tensor(found).T
    return {"chamfer_l1": chamfer, "f_score": f_score}


def _true_surfaces(dataset: ViewDataset, generator: torch.Generator) -> list[Tensor] | None:
    """Points [P, 3] on the true surface of every object, in the object frame; None if nothing is known."""
    convention = dataset.convention
    parts = np.split(np.arange(dataset.num_objects), range(256, dataset.num_objects, 256))
    if dataset.points is not None:
        return [points.float() for part in parts for points in torch.from_numpy(dataset.points[part])]
    if dataset.voxels is None:
        return None
    grids = (grid for part in parts for grid in convention.to_object(torch.from_numpy(dataset.voxels[part])))
    return [_sample(grid_surface(grid.float(), box=convention.cube_side), generator) for grid in grids]


def _sample(surface: Surface, generator: torch.Generator) -> Tensor:
    """Points [P, 3] on a surface; [0, 3] if it is empty."""
    if len(surface.faces) == 0:
        return torch.empty(0, 3)
    return nmr.metrics.sample_surface(surface.vertices, surface.faces, SURFACE_POINTS, generator=generator).points


def _other_images(object_ids: np.ndarray) -> Tensor:
    """For each sample another one of its object, int64 [M]: a quarter of the object's images further on.

    That is a quarter turn if the views go around the object. After half a turn the outline is the same, mirrored.
    """
    order = np.argsort(object_ids, kind="stable")
    others = np.empty_like(order)
    for group in np.split(order, np.flatnonzero(np.diff(object_ids[order])) + 1):
        others[group] = np.roll(group, -max(1, len(group) // 4))
    return torch.from_numpy(others)


def spread_samples(object_ids: np.ndarray, view_ids: np.ndarray, count: int) -> Tensor:
    """`count` different samples, int64 [count], ascending; a function of its arguments alone.

    Every view is among them about as often as any other, and so is every object: samples are taken one after the other
    in a shuffled order, each time from those whose view and object have been taken least.
    """
    total = len(object_ids)
    if count >= total:
        return torch.arange(total)
    order = np.random.default_rng(0).permutation(total)
    views, objects = view_ids[order], object_ids[order]
    load = np.zeros(total, int)
    chosen = np.empty(count, np.int64)
    for i in range(count):
        best = int(load.argmin())
        load += (views == views[best]).astype(int) + (objects == objects[best])
        load[best] += 2 * total
        chosen[i] = order[best]
    return torch.from_numpy(np.sort(chosen))


def mean_mmd(codes: Tensor, view_ids: Tensor, forms: Sequence[str] = ("mmd",)) -> dict[str, float]:
    """Mean MMD over all pairs of views (276 for 24) between the codes [N,C] of their images, by name of the form.

    Of each view the first 512 codes count, and no more than the view with the fewest has: with n codes the MMD has a
    bias of 1 / n. Views with one code are left out: between two single codes the MMD is a constant (6.19). {} if fewer
    than two views are left.
    """
    of_views = [codes[view_ids == view] for view in view_ids.unique()]
    of_views = [codes_of_view for codes_of_view in of_views if len(codes_of_view) > 1]
    if len(of_views) < 2:
        return {}
    size = min(CODES_PER_VIEW, *map(len, of_views))
    groups = [codes_of_view[:size].double() for codes_of_view in of_views]
    norms = [codes_of_view.square().sum(1) for codes_of_view in groups]

    def distances(i: int, j: int) -> Tensor:
        squared = torch.addmm(norms[j].expand(size, size), groups[i], groups[j].T, alpha=-2)
        return (squared + norms[i][:, None]).clamp_min_(0).float()

    within = [distances(i, i) for i in range(len(groups))]
    values = {form: [] for form in forms}
    for i, j in itertools.combinations(range(len(groups)), 2):
        between = distances(i, j)
        for form, found in values.items():
            kind = "paper" if form == "mmd_paper" else "released"
            found.append(float(mmd_from_distances(within[i], within[j], between, kind)))
    return {form: sum(found) / len(found) for form, found in values.items()}
