"""Voxel and silhouette IoU, surface distances and MMD of a trained method on a split."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import nmr
from learn3d.data.conventions import Definition, VoxelConvention, view_poses
from learn3d.data.dataset import MASK_SIZE, Batch, ViewDataset
from learn3d.data.poses import LookAtPoses, wrap_deg
from learn3d.losses import mmd
from learn3d.methods.method import Grids, Meshes, Method
from learn3d.pictures import TILE, Surface, draw_surface, grid_surface, natural_colors, orbit, tile
from learn3d.terminal import progress

# The picture grid of a training
TURNS_DEG = (0, 60, 120, 180, 240, 300)  # views of a shape, counted from the input's view
AROUND = [f"+{turn}°" for turn in TURNS_DEG[1:]]

CODES_PER_VIEW = 512
SURFACE_POINTS = 2000
F_SCORE_DISTANCE = 0.05  # units of the object frame: objects are 1 long (Pascal3D+: up to 2)
#: Angles between the azimuths of two images at which silhouettes are compared.
ANGLE_STEP_DEG = 15
ANGLES_DEG = range(0, 181, ANGLE_STEP_DEG)

#: Metrics of each image; learn3d.runs.measurement.MEASURES defines them. IoUs are NaN if both shapes are empty,
#: chamfer_l1 if one is. f_score is 0 if only the prediction is empty. precision, recall and voxel_iou are kato18's.
#: hollow is 1 if a mesh exceeds the grid: kato18 then leaves its inside empty.
MEASURED = (
    "voxel_iou",
    "voxel_iou_kato19",
    "voxel_iou_unclamped",
    "precision",
    "recall",
    "hollow",
    "chamfer_l1",
    "f_score",
    "silhouette_iou",
)
NO_MMD = "no MMD: it needs at least two view classes with at least two images each"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Metrics of each image of one split, and their means."""

    object_ids: Tensor  # int64 [M]
    view_ids: Tensor  # int64 [M]
    # float64 [M] by the names of `MEASURED`; NaN if undefined or not asked for
    values: dict[str, Tensor]
    # means without NaN, and "mmd", "mmd_paper", "mmd_floor"; undefined ones are left out
    means: dict[str, float]
    # mean IoU of silhouettes by the angle of `ANGLES_DEG` from the input's view; {} if not asked for
    angle_ious: dict[int, float] = dataclasses.field(default_factory=dict)

    @property
    def voxel_iou(self) -> float | None:
        return self.means.get("voxel_iou")

    @property
    def selection_metric(self) -> str:
        """Metric that selects the best checkpoint: the IoU of silhouettes, which needs no 3D
        data, if it is known.
        """
        return "silhouette_iou" if "silhouette_iou" in self.means else "voxel_iou"


@torch.no_grad()
def evaluate(
    method: Method,
    dataset: ViewDataset,
    *,
    max_images: int | None = None,
    detailed: bool = False,
    batch_size: int = 256,
    title: str | None = None,
) -> Evaluation:
    """Measure the shape of every image of a split, and the mean MMD over all pairs of view classes.

    Shapes are voxelized in the data set's convention and compared with the object's voxels. If
    poses are known, the silhouette of a mesh at the camera of another image of the object is
    compared with that image's mask. An object's only image is compared with its own mask. If
    voxels are known and no object has a second image, silhouettes are left out. A method in
    training is measured with its EMA weights.

    max_images: use only that many images, always the same ones (see `spread_samples`).
    detailed: add the voxel IoU with kato19, that without the clamp, the MMD as the paper prints it
    and its floor (`shuffle_views`), the IoU of silhouettes by angle (`images_by_angle`), and
    Chamfer-L1 and F-score between 2,000 points on each surface. If the data set has no points, both
    surfaces are those of kato18's voxels: the true voxels reach about half a cell, 1/64, beyond the
    true surface, so a mesh would have to be too thick to meet them.
    title: of the lines of progress (`terminal.progress`); None to show none.
    """
    samples = spread_samples(
        dataset.object_ids, dataset.view_ids, len(dataset) if max_images is None else max_images
    )
    comparison = _Comparison.of(dataset, detailed)
    codes, values, turned = [], [], []
    with method.in_use():
        for chosen in progress(samples.split(batch_size), title, unit="batch"):
            batch = dataset.batch(chosen)
            code = method.encode(batch.images)
            shapes = method.decode(code)
            measured = comparison.compare(shapes, batch, chosen)
            unknown = torch.full((len(chosen),), math.nan)
            values.append(
                torch.stack([measured.get(name, unknown).double() for name in MEASURED], dim=1)
            )
            turned.append(comparison.compare_by_angle(shapes, chosen))
            codes.append(code.float().cpu())
    figures = dict(zip(MEASURED, torch.cat(values).T, strict=True))
    means = {name: float(v.nanmean()) for name, v in figures.items() if not v.isnan().all()}
    by_angle = torch.cat(turned, dim=1).double().nanmean(1).tolist()
    object_ids, view_ids = (
        torch.from_numpy(ids[samples.numpy()]) for ids in (dataset.object_ids, dataset.view_ids)
    )
    return Evaluation(
        object_ids.long(),
        view_ids.long(),
        figures,
        means | _code_means(torch.cat(codes).double(), object_ids, view_ids, detailed),
        {a: iou for a, iou in zip(ANGLES_DEG, by_angle, strict=True) if not math.isnan(iou)},
    )


def _code_means(
    codes: Tensor, object_ids: Tensor, view_ids: Tensor, detailed: bool
) -> dict[str, float]:
    """The MMDs of `Evaluation.means`; {} if they are undefined."""
    mmds = mean_mmd(codes, view_ids, ("mmd", "mmd_paper") if detailed else ("mmd",))
    if detailed and mmds:
        mmds["mmd_floor"] = mean_mmd(codes, shuffle_views(object_ids, view_ids))["mmd"]
    return mmds


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Compares the shapes of a split with all that is known of its objects."""

    dataset: ViewDataset
    detailed: bool
    # int64 [N]: samples whose masks the silhouettes are compared with; None if none is compared
    others: Tensor | None
    at_angles: Tensor | None  # int64 [angles, N] of `images_by_angle`, if known and asked for
    surfaces: list[Tensor]  # points [P, 3] of each object; [] if unknown or not asked for
    generator: torch.Generator  # of points on surfaces

    @classmethod
    def of(cls, dataset: ViewDataset, detailed: bool) -> "_Comparison":
        others = _other_images(dataset.object_ids)
        novel_views = bool((others != torch.arange(len(others))).any())
        compared = dataset.poses is not None and (novel_views or dataset.voxels is None)
        at_angles = None
        if detailed and novel_views and isinstance(dataset.poses, LookAtPoses):
            at_angles = images_by_angle(dataset.object_ids, dataset.poses.azimuth_deg)
        generator = torch.Generator().manual_seed(0)
        surfaces = _true_surfaces(dataset, generator) if detailed else []
        return cls(dataset, detailed, others if compared else None, at_angles, surfaces, generator)

    def compare(self, shapes: Meshes | Grids, batch: Batch, samples: Tensor) -> dict[str, Tensor]:
        """The measures [B] of a batch's shapes, by the names of `MEASURED`, that are defined."""
        measured = {}
        if self.dataset.voxels is not None:
            filled = self._voxelize(shapes)
            measured = self._compare_voxels(shapes, filled, batch)
        if self.others is not None and isinstance(shapes, Meshes):
            measured["silhouette_iou"] = self._compare_silhouettes(shapes, self.others[samples])
        if self.surfaces:
            surfaces = (
                shapes.surfaces()
                if self.dataset.points is not None
                else _surfaces_of_voxels(filled, self.dataset.convention)
            )
            measured |= self._compare_surfaces(surfaces, batch)
        return measured

    def compare_by_angle(self, shapes: Meshes | Grids, samples: Tensor) -> Tensor:
        """IoU of silhouettes at the images of `at_angles`: float32 [angles, B], NaN if unknown."""
        if self.at_angles is None or not isinstance(shapes, Meshes):
            return torch.full((len(ANGLES_DEG), len(samples)), math.nan)
        others = self.at_angles[:, samples]
        return torch.stack([self._compare_silhouettes(shapes, chosen) for chosen in others])

    def _voxelize(self, shapes: Meshes | Grids, definition: Definition = "kato18") -> Tensor:
        """Occupancy of predictions, in the axes of the stored voxels: bool [B, 32, 32, 32].

        A grid has no definition: it is pooled to that size.
        """
        convention = self.dataset.convention
        if isinstance(shapes, Meshes):
            return convention.voxelize(shapes.vertices, shapes.faces, definition)
        if convention.cube_side != 1.0:
            raise ValueError(
                f"grids over the box [-0.5, 0.5] cannot be compared with {convention.name} voxels"
            )
        return convention.to_axes(shapes.occupied(self.dataset.voxels.shape[-1]))

    def _compare_voxels(
        self, shapes: Meshes | Grids, filled: Tensor, batch: Batch
    ) -> dict[str, Tensor]:
        """The measures of voxels. filled: kato18's voxels of the shapes."""
        precision, recall = nmr.metrics.voxel_precision_recall(filled, batch.voxels)
        hollow = torch.zeros(len(batch))
        if isinstance(shapes, Meshes):
            hollow = self.dataset.convention.exceeds_grid(shapes.vertices)
        iou = nmr.metrics.voxel_iou(filled, batch.voxels)
        measured = {"voxel_iou": iou, "precision": precision, "recall": recall, "hollow": hollow}
        if self.detailed:
            unclamped = shapes.without_clamp() if isinstance(shapes, Meshes) else None
            grids = {
                "voxel_iou_kato19": self._voxelize(shapes, "kato19"),
                "voxel_iou_unclamped": filled if unclamped is None else self._voxelize(unclamped),
            }
            for name, grid in grids.items():
                measured[name] = nmr.metrics.voxel_iou(grid, batch.voxels)
        return measured

    def _compare_silhouettes(self, shapes: Meshes, samples: Tensor) -> Tensor:
        """IoU of the silhouette of each shape at the camera of a sample with the sample's mask:
        float32 [B], sum of minima over sum of maxima.

        NaN if both are empty, or if the sample is -1.
        """
        ious = torch.full((len(samples),), math.nan)
        known = samples >= 0
        if known.any():
            samples = samples[known]
            masks = torch.from_numpy(self.dataset.read_masks(samples.numpy())) / 255
            silhouettes = nmr.render_silhouette(
                shapes.vertices[known],
                shapes.faces,
                self.dataset.poses[samples].cameras(),
                image_size=MASK_SIZE,
            )
            both = torch.minimum(silhouettes, masks).sum((1, 2))
            ious[known] = both / torch.maximum(silhouettes, masks).sum((1, 2))
        return ious

    def _compare_surfaces(self, surfaces: list[Surface], batch: Batch) -> dict[str, Tensor]:
        """Chamfer-L1 and F-score with the true points of the batch's objects."""
        found = []
        for surface, number in zip(surfaces, batch.object_ids.tolist(), strict=True):
            ours, theirs = _sample(surface, self.generator), self.surfaces[number]
            if len(ours) and len(theirs):
                distance = nmr.metrics.chamfer_distance(ours, theirs, form="l1")
                f_score = nmr.metrics.f_score(ours, theirs, F_SCORE_DISTANCE)
                found.append((float(distance), float(f_score)))
            else:
                found.append((math.nan, 0.0 if len(ours) or len(theirs) else math.nan))
        chamfer, f_score = torch.tensor(found).T
        return {"chamfer_l1": chamfer, "f_score": f_score}


def _true_surfaces(dataset: ViewDataset, generator: torch.Generator) -> list[Tensor]:
    """Points [P, 3] on the true surface of every object, in the object frame; [] if unknown."""
    found = []
    for part in np.split(np.arange(dataset.num_objects), range(256, dataset.num_objects, 256)):
        if dataset.points is not None:
            found += torch.from_numpy(dataset.points[part]).float()
        elif dataset.voxels is not None:
            voxels = torch.from_numpy(dataset.voxels[part])
            surfaces = _surfaces_of_voxels(voxels, dataset.convention)
            found += [_sample(surface, generator) for surface in surfaces]
    return found


def _surfaces_of_voxels(voxels: Tensor, convention: VoxelConvention) -> list[Surface]:
    """The surfaces of grids [B, s, s, s] in the axes of the stored voxels, in the object frame."""
    return [
        grid_surface(grid, box=convention.cube_side)
        for grid in convention.to_object(voxels).float()
    ]


def _sample(surface: Surface, generator: torch.Generator) -> Tensor:
    """Points [P, 3] on a surface; [0, 3] if it is empty."""
    if len(surface.faces) == 0:
        return torch.empty(0, 3)
    return nmr.metrics.sample_surface(
        surface.vertices, surface.faces, SURFACE_POINTS, generator=generator
    ).points


def _images_of_objects(object_ids: np.ndarray) -> list[np.ndarray]:
    """The samples of each object, int64 [V], in their order."""
    order = np.argsort(object_ids, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(object_ids[order])) + 1)


def _other_images(object_ids: np.ndarray) -> Tensor:
    """For each sample another of its object, int64 [M]: a quarter of its images further on.

    If views go around the object, that is a quarter turn. Half a turn would show the same
    outline, mirrored.
    """
    others = np.empty(len(object_ids), np.int64)
    for group in _images_of_objects(object_ids):
        others[group] = np.roll(group, -max(1, len(group) // 4))
    return torch.from_numpy(others)


def images_by_angle(object_ids: np.ndarray, azimuth_deg: Tensor) -> Tensor:
    """For each angle of `ANGLES_DEG` and each sample, an image of the same object whose azimuth
    differs by that angle, to the nearest of them: int64 [angles, M], -1 if there is none.

    Of several images the next one after the sample is taken, so 0 is the sample itself.
    """
    found = torch.full((len(ANGLES_DEG), len(object_ids)), -1)
    for group in map(torch.from_numpy, _images_of_objects(object_ids)):
        count = len(group)
        azimuths = azimuth_deg[group]
        steps = (wrap_deg(azimuths[None] - azimuths[:, None]).abs() / ANGLE_STEP_DEG).round()
        places = torch.arange(count)
        after = (places[None] - places[:, None]) % count
        for step in range(len(ANGLES_DEG)):
            nearest = torch.where(steps == step, after, count).min(dim=1)
            found[step, group] = torch.where(nearest.values < count, group[nearest.indices], -1)
    return found


def shuffle_views(object_ids: Tensor, view_ids: Tensor) -> Tensor:
    """The view classes of samples, permuted at random within each object; always the same way.

    The MMD between such classes is the value that codes without pose would have with as many
    images: a floor that comes from the number of objects alone.
    """
    rng = np.random.default_rng(0)
    shuffled = view_ids.clone()
    for group in _images_of_objects(object_ids.numpy()):
        shuffled[group] = view_ids[rng.permutation(group)]
    return shuffled


def spread_samples(object_ids: np.ndarray, view_ids: np.ndarray, count: int) -> Tensor:
    """`count` different samples, int64 [count], ascending, spread evenly over views and objects;
    always the same ones.

    Samples are taken one by one in a shuffled order, each time from the views and objects that
    were taken least.
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
    """Mean MMD between the codes [N,C] of two views, over all pairs of views, for each of `forms`.

    The MMD of n codes has a bias of 1 / n, so every view has the same number of codes: that of
    the view with the fewest, at most 512. Views with one code are left out, as the MMD between
    two single codes is a constant. The result is {} if fewer than two views are left.
    """
    groups = [codes[view_ids == view].double() for view in view_ids.unique()]
    groups = [group for group in groups if len(group) > 1]
    if len(groups) < 2:
        return {}
    size = min(CODES_PER_VIEW, *map(len, groups))
    groups = [group[:size] for group in groups]
    norms = [group.square().sum(1) for group in groups]

    def distances(i: int, j: int) -> Tensor:
        squared = torch.addmm(norms[j].expand(size, size), groups[i], groups[j].T, alpha=-2)
        return (squared + norms[i][:, None]).clamp_min_(0).float()

    within = [distances(i, i) for i in range(len(groups))]
    values = {form: [] for form in forms}
    for i, j in itertools.combinations(range(len(groups)), 2):
        between = distances(i, j)
        for form, found in values.items():
            kind = "paper" if form == "mmd_paper" else "released"
            found.append(float(mmd(within[i], within[j], between, kind)))
    return {form: sum(found) / len(found) for form, found in values.items()}


@torch.no_grad()
def picture_grid(method: Method, dataset: ViewDataset, indices: Tensor) -> np.ndarray:
    """Inputs and results of a method in training: uint8 [H,W,3].

    A row per image: the input, the target silhouette, the rendered silhouette and the shaded
    shape at the input's view, and the shape from five more views around it.
    """
    batch = dataset.batch(indices)
    with method.in_use():
        shapes = method.decode(method.encode(batch.images)).surfaces()
    inputs = natural_colors(batch.images.numpy(), inverted=dataset.inverted)
    rows = []
    for i, (vertices, faces, *_) in enumerate(shapes):
        pose = view_poses(torch.zeros(1)) if batch.poses is None else batch.poses[torch.tensor([i])]
        rendering = torch.zeros(MASK_SIZE, MASK_SIZE)
        if len(faces):
            rendering = nmr.render_silhouette(
                vertices[None], faces, pose.cameras(), image_size=MASK_SIZE
            )[0]
        greys = (
            (torch.stack([batch.masks[i], rendering]).clamp(0, 1) * 255)
            .round()
            .to(torch.uint8)
            .numpy()
        )
        views = draw_surface(shapes[i], orbit(pose, TURNS_DEG), image_size=TILE)
        rows.append([inputs[i], *np.repeat(greys[..., None], 3, axis=-1), *views])
    return tile(rows, ["input", "target", "rendering", "same view", *AROUND])
