"""Poses of all images of a data set: estimated from masks, corrected in a training, compared with true ones, drawn.

A training gives the candidate poses of an image new probabilities: the shape that the model predicts from the image is
rendered at all of them. As all images share the networks, the shape of an image with a wrong pose is still predicted in
the frame of the others, so its IoU with the mask is best at the right pose.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

import nmr
from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.layouts import Layout, load_dataset
from learn3d.data.pose_table import MAX_CANDIDATES, PoseTable, fingerprints
from learn3d.data.poses import LookAtPoses, wrap_deg
from learn3d.files import limits
from learn3d.files.reading import MissingFile
from learn3d.methods.mesh_method import MeshMethod
from learn3d.pictures.sheets import natural_colors, tile
from learn3d.pictures.surfaces import Surface, draw_surface, orbit
from learn3d.poses.estimate import (
    MIN_IMAGES,
    NEAR_DEG,
    SIZE,
    TEMPERATURE,
    Candidates,
    Estimate,
    Masks,
    PoseOptions,
    estimate,
)
from learn3d.settings import checked

MAX_ELEVATION_STEP_DEG = 15.0  # between neighbouring candidates
DEFAULT_ELEVATION_DEG, DEFAULT_FOV_DEG = 30.0, 30.0
MIN_CONFIDENCE = 0.5  # an image with less counts as doubtful
COLUMNS = 12  # azimuths on the sheet, at most
PROTOTYPES, ROWS = 6, 8  # rows of prototypes, and of images, at most
TILE = 64  # side of a picture in pixels
_MIN_FRONT_VOTES = 0.8  # `Estimate.front_votes` of objects whose front and back differ
_IMAGES = 128  # images whose poses are reweighted at a time
_CELL_DEG = 15  # width of the cells of azimuth whose frequency is kept
_LEAST_PRIOR = 0.01  # probability of candidates that the table leaves out
_ROUNDS = 20  # rounds of scaling to these frequencies


@checked
class CameraOptions:
    """Known values of the cameras."""

    elevation: str | None = None
    """Elevation of all cameras in degrees, or a range LOW:HIGH (default: from the data set, or 30 if it has none)."""
    distance: Annotated[float, Field(gt=0.5, lt=limits.DISTANCE[1])] | None = None
    """Distance of all cameras, in units of the object's longest side (default: from the data set, or estimated from the
    largest mask)."""
    fov_deg: Annotated[float, Field(gt=limits.FOV_DEG[0], lt=limits.FOV_DEG[1])] | None = None
    """Full field of view of all cameras in degrees (default: from the data set, or 30 if it has none)."""

    def elevations(self) -> tuple[float, float] | None:
        """The lowest and the highest elevation; None if no elevation is given. Raises ValueError for bad text."""
        if self.elevation is None:
            return None
        low, _, high = self.elevation.partition(":")
        with contextlib.suppress(ValueError):
            if -90 < float(low) <= float(high or low) < 90:
                return float(low), float(high or low)
        raise ValueError(f"elevation must be degrees within -90 .. 90, or LOW:HIGH, got {self.elevation!r}")


@dataclass(frozen=True, eq=False)
class EstimatedViews:
    """The images of all splits, concatenated, and their poses."""

    datasets: tuple[ViewDataset, ...]
    shown: Tensor  # int64: rows of the images whose masks are not empty
    candidates: Candidates
    result: Estimate  # for the rows `shown`
    table: PoseTable  # for all rows

    @property
    def warnings(self) -> list[str]:
        """Reasons to distrust the poses."""
        warnings = []
        if empty := len(self.table.confidence) - len(self.shown):
            warnings.append(f"{empty} images have an empty mask; their poses are unknown")
        training = int((self.shown < len(self.datasets[0])).sum())
        if training < MIN_IMAGES:
            warnings.append(f"{training} training images are too few to estimate poses; the minimum is {MIN_IMAGES}")
        elif float(self.result.confidence.mean()) < MIN_CONFIDENCE:
            warnings.append(
                "these masks do not determine the poses: nearly equal masks of different objects got different "
                "azimuths, so objects may look alike from several sides. Check the sheet before training on this table"
            )
        elif self.result.front_votes < _MIN_FRONT_VOTES:
            warnings.append("many masks look the same from front and back: azimuths may be wrong by 180 degrees")
        return warnings


def load_views(layout: Layout, data: Path, category: str, views_per_object: int | None = None) -> list[ViewDataset]:
    """Read the training split of a data set, and those of the other splits that exist."""
    datasets = [load_dataset(layout, data, category, "train", views_per_object=views_per_object)]
    for split in ("val", "test"):
        with contextlib.suppress(MissingFile):
            datasets.append(load_dataset(layout, data, category, split))
    return datasets


def estimate_views(datasets: Sequence[ViewDataset], cameras: CameraOptions, options: PoseOptions) -> EstimatedViews:
    """Estimate the poses of all images. Shapes are fitted to the images of the first data set, the training split.

    The table holds up to MAX_CANDIDATES poses of each image, which a training can reweight. Raises ValueError if all
    training masks are empty, or if the data set's poses are rotations.
    """
    elevation, distance, half_fov = _cameras(datasets, cameras)
    size = distance * torch.tan(half_fov.deg2rad())
    magnified = size / (distance.median() * torch.tan(half_fov.median().deg2rad()))
    masks = _masks(datasets, magnified)
    shown = torch.nonzero(masks.sum(1) > 0.25)[:, 0]
    training = shown[shown < len(datasets[0])]
    if not len(training):
        raise ValueError("all training masks are empty; run learn3d check-dataset on the data")
    span = cameras.elevations() or (float(elevation.min()), float(elevation.max()))
    grid = torch.linspace(*span, 1 + int(np.ceil((span[1] - span[0]) / MAX_ELEVATION_STEP_DEG)))
    azimuths = torch.arange(options.azimuths) * (360 / options.azimuths)
    candidates = Candidates(azimuths, grid, float(distance.median()), float(half_fov.median()))
    own_elevation = cameras.elevation is None  # the elevation of each image is known
    nearest = (elevation[:, None] - grid).abs().argmin(1)
    allowed = (nearest[:, None] == torch.arange(len(grid))) | (not own_elevation)
    data = Masks(masks, allowed, _objects(datasets)).select(shown)
    result = estimate(data, torch.searchsorted(shown, training), candidates, options)

    posterior = torch.full((len(masks), len(azimuths), len(grid)), 1 / (len(azimuths) * len(grid)))
    posterior[shown] = result.posterior
    if own_elevation:
        posterior = posterior.sum(2, keepdim=True)
    weights, chosen = posterior.flatten(1).topk(min(MAX_CANDIDATES, posterior[0].numel()), 1)
    weights[:, options.candidates :] = 0
    azimuth, height = chosen // posterior.shape[2], chosen % posterior.shape[2]
    heights = elevation[:, None].expand_as(weights) if own_elevation else grid[height]
    confidence = torch.zeros(len(masks)).index_copy(0, shown, result.confidence)
    columns = (wrap_deg(azimuths[azimuth]), heights, weights / weights.sum(1, keepdim=True))
    columns = (part.numpy().astype(np.float32) for part in (*columns, distance, half_fov, confidence))
    table = PoseTable(np.concatenate([fingerprints(dataset) for dataset in datasets]), *columns)
    return EstimatedViews(tuple(datasets), shown, candidates, result, table)


def _cameras(datasets: Sequence[ViewDataset], cameras: CameraOptions) -> tuple[Tensor, Tensor, Tensor]:
    """Elevation, distance and half field of view of every image: the given ones, the data set's, or defaults."""
    given = cameras.elevations() or (DEFAULT_ELEVATION_DEG,) * 2
    half_fov = torch.full((sum(map(len, datasets)),), (cameras.fov_deg or DEFAULT_FOV_DEG) / 2)
    largest = max(float(dataset.object_sizes().max()) for dataset in datasets)
    guess = 0.5 / (max(largest, 0.01) * np.tan(np.radians(float(half_fov[0]))))
    distance, elevation = torch.full_like(half_fov, guess), torch.full_like(half_fov, sum(given) / 2)
    if any(dataset.poses is not None for dataset in datasets):
        if not all(isinstance(dataset.poses, LookAtPoses) for dataset in datasets):
            raise ValueError("poses can only be estimated for look-at cameras; the poses of this layout are rotations")
        poses = vars(LookAtPoses.join([dataset.poses for dataset in datasets])).values()
        _, own_elevation, distance, own_fov = (torch.as_tensor(part).expand(len(half_fov)) for part in poses)
        elevation = own_elevation if cameras.elevation is None else elevation
        half_fov = half_fov if cameras.fov_deg else own_fov
    if cameras.distance is not None:
        distance = torch.full_like(half_fov, cameras.distance)
    return elevation, distance, half_fov


def _objects(datasets: Sequence[ViewDataset]) -> Tensor:
    """The object of each image, numbered through all data sets: int64 [N]."""
    starts = np.cumsum([0, *(dataset.num_objects for dataset in datasets)])
    ids = np.concatenate([d.object_ids + start for d, start in zip(datasets, starts, strict=False)])
    return torch.from_numpy(ids).long()


def _masks(datasets: Sequence[ViewDataset], factor: Tensor) -> Tensor:
    """Masks float32 [N, SIZE^2] in 0 .. 1, read in parts, as images may exceed memory.

    Each is magnified about its centre by its factor: an approximate change of the distance or of the field of view.
    """
    reduced = []
    for dataset, of_dataset in zip(datasets, factor.split([len(d) for d in datasets]), strict=True):
        for rows in torch.arange(len(dataset)).split(1024):
            masks, factors = torch.from_numpy(dataset.read_masks(rows.numpy()))[:, None].float() / 255, of_dataset[rows]
            if bool((factors - 1).abs().max() >= 1e-3):
                grid = F.affine_grid(torch.eye(2, 3) / factors[:, None, None], masks.shape, align_corners=False)
                masks = F.grid_sample(masks, grid, align_corners=False)
            reduced.append(F.avg_pool2d(masks, MASK_SIZE // SIZE).flatten(1))
    return torch.cat(reduced)


def update_steps(iterations: int, count: int) -> tuple[int, ...]:
    """The steps of a run after which poses are reweighted: 1/2, 1/4, ... of its length."""
    return tuple(iterations >> k for k in range(count, 0, -1) if iterations >> k)


@torch.no_grad()
def update_poses(method: MeshMethod, dataset: ViewDataset) -> float:
    """Reweight the candidates of all images of `dataset`; returns the share of images whose best pose changed.

    The weights are softmax(IoU / TEMPERATURE + log p + b) over the candidates, with masks and renderings of SIZE
    pixels. p is the candidate's probability in the table, at least _LEAST_PRIOR. b is a number for each 15 degrees of
    azimuth, chosen so that each such cell keeps its frequency in the table.
    """
    candidates, logits = dataset.candidates, []
    count = candidates.weights.shape[1]
    with method.in_use():
        for rows in torch.arange(len(dataset)).split(_IMAGES):
            batch = dataset.batch(rows, voxels=False)
            shapes = method.decode(method.encode(batch.images))
            poses = candidates.poses[(rows[:, None] * count + torch.arange(count)).flatten()]
            vertices = shapes.vertices.repeat_interleave(count, 0)
            silhouettes = nmr.render_silhouette(vertices, shapes.faces, poses.cameras(), image_size=SIZE)
            masks = F.avg_pool2d(batch.masks[:, None], MASK_SIZE // SIZE).expand(-1, count, -1, -1)
            silhouettes = silhouettes.view(masks.shape)
            common = (silhouettes * masks).sum((2, 3))
            logits.append(common / ((silhouettes + masks).sum((2, 3)) - common).clamp_min(1e-6) / TEMPERATURE)
    prior = torch.from_numpy(candidates.prior)
    logits = torch.cat(logits) + prior.clamp_min(_LEAST_PRIOR).log()
    weights = _with_marginal(logits, candidates.poses.azimuth_deg.view(prior.shape), prior).numpy()
    changed = float((weights.argmax(1) != candidates.weights.argmax(1)).mean())
    candidates.weights[:] = weights
    return changed


def _with_marginal(logits: Tensor, azimuth_deg: Tensor, prior: Tensor) -> Tensor:
    """Softmax of logits [M, C] plus a number for each cell of azimuths, which gives the cell its share in `prior`."""
    cells = 360 // _CELL_DEG
    cell = ((azimuth_deg / _CELL_DEG).round().long() % cells).flatten()
    wanted = torch.bincount(cell, prior.flatten(), minlength=cells).clamp_min(1e-6)
    weights, shift = logits.softmax(1), torch.zeros(cells, dtype=torch.float64)
    for _ in range(_ROUNDS):
        shift += (wanted / torch.bincount(cell, weights.flatten(), minlength=cells).clamp_min(1e-6)).log()
        weights = (logits + shift[cell].float().view(logits.shape)).softmax(1)
    return weights


@dataclass(frozen=True)
class Comparison:
    """Errors of the estimated azimuths, after the whole frame was turned by `offset_deg`."""

    offset_deg: float
    accuracy: float  # Acc@30: share of errors of at most 30 degrees
    half_turn_accuracy: float  # the same, if half a turn does not count: many tables look the same from behind
    median_deg: float
    mean_deg: float
    flips: float  # share of errors of at least 150 degrees
    objects_flipped: float  # share of the objects with flips in most of their images
    calibration: tuple[tuple[float, float, int], ...]  # mean confidence, accuracy and number of images, by confidence

    def text(self) -> str:
        """Lines for the terminal."""
        lines = [
            f"against the data's azimuths (frame turned by {self.offset_deg:g} degrees): Acc@30 {self.accuracy:.3f}, "
            f"up to half a turn {self.half_turn_accuracy:.3f}, median error {self.median_deg:.1f}, "
            f"mean {self.mean_deg:.1f} degrees, flips {self.flips:.3f}, "
            f"objects flipped as a whole {self.objects_flipped:.3f}"
        ]
        return "\n".join(lines + [f"confidence {c:.2f}: Acc@30 {a:.2f} ({n} images)" for c, a, n in self.calibration])


def compare(views: EstimatedViews) -> Comparison:
    """Compare the most probable azimuths with the true ones.

    The frame is turned by the whole number of degrees with the smallest sum of two mean errors, over all images but
    those of the test split: that of the azimuths, and that up to half a turn, which alone decides for objects that look
    the same from front and back. Raises ValueError if the data set has no poses.
    """
    if any(dataset.poses is None for dataset in views.datasets):
        raise ValueError("--compare needs true poses, but this data set has none")
    true = torch.cat([dataset.poses.azimuth_deg for dataset in views.datasets])
    found = torch.from_numpy(views.table.azimuth_deg[:, 0])
    chosen = torch.cat([torch.full((len(dataset),), dataset.split != "test") for dataset in views.datasets])
    offsets = torch.arange(360.0)
    turned = (wrap_deg(found[chosen] + o - true[chosen]).abs() for o in offsets)
    offset = float(offsets[torch.stack([(e + _up_to_half_turn(e)).mean() for e in turned]).argmin()])
    errors = wrap_deg(found + offset - true).abs()[views.shown]
    flips = (errors >= 150).double()
    _, which = _objects(views.datasets)[views.shown].unique(return_inverse=True)
    by_object = torch.bincount(which, flips) / torch.bincount(which)
    right, confidence = (errors <= NEAR_DEG).double(), views.result.confidence.double()
    bins = [torch.nonzero((10 * confidence).floor().clamp(max=9) == k)[:, 0] for k in range(10)]
    calibration = tuple((float(confidence[b].mean()), float(right[b].mean()), len(b)) for b in bins if len(b))
    up_to_half_turn = (_up_to_half_turn(errors) <= NEAR_DEG).double()
    numbers = (right.mean(), up_to_half_turn.mean(), errors.median(), errors.mean(), flips.mean())
    return Comparison(offset, *map(float, (*numbers, (by_object > 0.5).double().mean())), calibration)


def _up_to_half_turn(errors: Tensor) -> Tensor:
    return torch.minimum(errors, 180 - errors)


def draw_sheet(views: EstimatedViews, offset_deg: float = 0.0) -> np.ndarray:
    """Uint8 [H, W, 3]: the most frequent prototypes, and below each azimuth images with about that estimate.

    offset_deg: added to the azimuths of images and prototypes, as by `PoseTable.turned`.
    """
    (directions, heights, distance, half_fov), result = views.candidates, views.result
    count = min(COLUMNS, len(directions))
    azimuths = directions[torch.linspace(0, len(directions), count + 1)[:-1].long()]
    middle = heights[len(heights) // 2 :][:1]
    cameras = orbit(LookAtPoses(torch.full((1,), -offset_deg), middle, distance, half_fov), azimuths.tolist())
    order = result.weights.argsort(descending=True)[:PROTOTYPES]
    rows = [list(draw_surface(Surface(result.prototypes[m], result.faces), cameras, image_size=TILE)) for m in order]
    places = [(dataset, i) for dataset in views.datasets for i in range(len(dataset))]
    found = torch.from_numpy(views.table.azimuth_deg[:, 0])[views.shown] + offset_deg
    columns = []
    for azimuth in azimuths:
        near = torch.nonzero(torch.remainder(found - azimuth + 180 / count, 360) < 360 / count)[:, 0]
        chosen = near[torch.linspace(0, len(near) - 1, min(ROWS, len(near))).long()]
        pictures = []
        for row in views.shown[chosen].tolist():
            dataset, index = places[row]
            pictures.append(natural_colors(dataset.images[np.array([index])], inverted=dataset.inverted)[0])
        columns.append(pictures + [None] * (ROWS - len(pictures)))
    names = [f"prototype, {float(result.weights[m]):.0%}" for m in order] + ["images", *[""] * (ROWS - 1)]
    titles = [f"{azimuth:g}°" for azimuth in azimuths.tolist()]
    return tile(
        [*rows, *map(list, zip(*columns, strict=True))], titles, tile_size=TILE, row_titles=names, rules=(len(rows),)
    )
