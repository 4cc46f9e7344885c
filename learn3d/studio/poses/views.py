"""Poses of all images of a data set, estimated from masks."""

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

from learn3d.data.dataset import MASK_SIZE, ViewDataset
from learn3d.data.layouts import Layout, load_dataset
from learn3d.data.pose_table import MAX_CANDIDATES, PoseTable, fingerprints
from learn3d.data.poses import LookAtPoses, wrap_deg
from learn3d.files import limits
from learn3d.files.reading import MissingFile
from learn3d.methods.pose_updates import SIZE
from learn3d.settings import checked
from learn3d.studio.poses.estimate import MIN_IMAGES, Estimate, estimate
from learn3d.studio.poses.neighbours import Masks
from learn3d.studio.poses.options import PoseOptions
from learn3d.studio.poses.prototypes import CandidatePoses

MAX_ELEVATION_STEP_DEG = 15.0  # between neighbouring candidates
DEFAULT_ELEVATION_DEG, DEFAULT_FOV_DEG = 30.0, 30.0
MIN_CONFIDENCE = 0.5  # an image with less counts as doubtful
_MIN_FRONT_VOTES = 0.8  # `Estimate.front_votes` of objects whose front and back differ


@checked
class CameraOptions:
    """Known values of the cameras."""

    elevation: str | None = None
    """Elevation of all cameras in degrees, or a range LOW:HIGH. If not given: from the data set, or
    30 if it has none."""
    distance: Annotated[float, Field(gt=0.5, lt=limits.CAMERA_DISTANCE[1])] | None = None
    """Distance of all cameras, in units of the object's longest side. If not given: from the data
    set, or estimated from the largest mask."""
    fov_deg: Annotated[float, Field(gt=limits.FOV_DEG[0], lt=limits.FOV_DEG[1])] | None = None
    """Full field of view of all cameras in degrees. If not given: from the data set, or 30 if it
    has none."""

    def elevations(self) -> tuple[float, float] | None:
        """The lowest and the highest elevation; None if no elevation is given.

        Raises ValueError for bad text.
        """
        if self.elevation is None:
            return None
        low, _, high = self.elevation.partition(":")
        with contextlib.suppress(ValueError):
            if -90 < float(low) <= float(high or low) < 90:
                return float(low), float(high or low)
        raise ValueError(
            f"elevation must be degrees within -90 .. 90, or LOW:HIGH, got {self.elevation!r}"
        )


@dataclass(frozen=True, eq=False)
class EstimatedViews:
    """The images of all splits, concatenated, and their poses."""

    datasets: tuple[ViewDataset, ...]
    shown: Tensor  # int64: rows of the images whose masks are not empty
    candidates: CandidatePoses
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
            warnings.append(
                f"{training} training images are too few to estimate poses; the minimum is {MIN_IMAGES}"
            )
        elif float(self.result.confidence.mean()) < MIN_CONFIDENCE:
            warnings.append(
                "these masks do not determine the poses: nearly equal masks of different objects got different "
                "azimuths, so objects may look alike from several sides. Check the sheet before training on this table"
            )
        elif self.result.front_votes < _MIN_FRONT_VOTES:
            warnings.append(
                "many masks look the same from front and back: azimuths may be wrong by 180 degrees"
            )
        return warnings


def load_views(
    layout: Layout, data: Path, category: str, views_per_object: int | None = None
) -> list[ViewDataset]:
    """Read the training split of a data set, and those of the other splits that exist."""
    datasets = [load_dataset(layout, data, category, "train", views_per_object=views_per_object)]
    for split in ("val", "test"):
        with contextlib.suppress(MissingFile):
            datasets.append(load_dataset(layout, data, category, split))
    return datasets


def estimate_views(
    datasets: Sequence[ViewDataset], cameras: CameraOptions, options: PoseOptions
) -> EstimatedViews:
    """Estimate the poses of all images.

    Shapes are fitted to the images of the first data set, the training split.

    The table holds up to MAX_CANDIDATES poses of each image, which a training can reweight.
    Raises ValueError if all training masks are empty, or if the data set's poses are rotations.
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
    candidates = CandidatePoses(azimuths, grid, float(distance.median()), float(half_fov.median()))
    own_elevation = cameras.elevation is None  # the elevation of each image is known
    nearest = (elevation[:, None] - grid).abs().argmin(1)
    allowed = (nearest[:, None] == torch.arange(len(grid))) | (not own_elevation)
    data = Masks(masks, allowed, number_objects(datasets)).select(shown)
    result = estimate(data, torch.searchsorted(shown, training), candidates, options)

    posterior = torch.full((len(masks), len(azimuths), len(grid)), 1 / (len(azimuths) * len(grid)))
    posterior[shown] = result.posterior
    if own_elevation:
        posterior = posterior.sum(2, keepdim=True)
    weights, chosen = posterior.flatten(1).topk(min(MAX_CANDIDATES, posterior[0].numel()), 1)
    weights[:, options.candidates :] = 0
    azimuth = chosen // posterior.shape[2]
    heights = (
        elevation[:, None].expand_as(weights)
        if own_elevation
        else grid[chosen % posterior.shape[2]]
    )
    confidence = torch.zeros(len(masks)).index_copy(0, shown, result.confidence)
    columns = (wrap_deg(azimuths[azimuth]), heights, weights / weights.sum(1, keepdim=True))
    columns = (
        part.numpy().astype(np.float32) for part in (*columns, distance, half_fov, confidence)
    )
    table = PoseTable(np.concatenate([fingerprints(dataset) for dataset in datasets]), *columns)
    return EstimatedViews(tuple(datasets), shown, candidates, result, table)


def _cameras(
    datasets: Sequence[ViewDataset], cameras: CameraOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Elevation, distance and half field of view of all images: given, the data's, or defaults."""
    given = cameras.elevations() or (DEFAULT_ELEVATION_DEG,) * 2
    half_fov = torch.full((sum(map(len, datasets)),), (cameras.fov_deg or DEFAULT_FOV_DEG) / 2)
    largest = max(float(dataset.object_sizes().max()) for dataset in datasets)
    guess = 0.5 / (max(largest, 0.01) * np.tan(np.radians(float(half_fov[0]))))
    distance = torch.full_like(half_fov, guess)
    elevation = torch.full_like(half_fov, sum(given) / 2)
    if any(dataset.poses is not None for dataset in datasets):
        if not all(isinstance(dataset.poses, LookAtPoses) for dataset in datasets):
            raise ValueError(
                "poses can only be estimated for look-at cameras; the poses of this layout are rotations"
            )
        poses = vars(LookAtPoses.join([dataset.poses for dataset in datasets])).values()
        _, own_elevation, distance, own_fov = (
            torch.as_tensor(part).expand(len(half_fov)) for part in poses
        )
        elevation = own_elevation if cameras.elevation is None else elevation
        half_fov = half_fov if cameras.fov_deg else own_fov
    if cameras.distance is not None:
        distance = torch.full_like(half_fov, cameras.distance)
    return elevation, distance, half_fov


def number_objects(datasets: Sequence[ViewDataset]) -> Tensor:
    """The object of each image, numbered through all data sets: int64 [N]."""
    starts = np.cumsum([0, *(dataset.num_objects for dataset in datasets)])
    ids = np.concatenate([d.object_ids + start for d, start in zip(datasets, starts, strict=False)])
    return torch.from_numpy(ids).long()


def _masks(datasets: Sequence[ViewDataset], factor: Tensor) -> Tensor:
    """Masks float32 [N, SIZE^2] in 0 .. 1, read in parts, as images may exceed memory.

    Each is magnified about its centre by its factor: an approximate change of the distance or of
    the field of view.
    """
    reduced = []
    for dataset, of_dataset in zip(datasets, factor.split([len(d) for d in datasets]), strict=True):
        for rows in torch.arange(len(dataset)).split(1024):
            masks = torch.from_numpy(dataset.read_masks(rows.numpy()))[:, None].float() / 255
            factors = of_dataset[rows]
            if bool((factors - 1).abs().max() >= 1e-3):
                grid = F.affine_grid(
                    torch.eye(2, 3) / factors[:, None, None], masks.shape, align_corners=False
                )
                masks = F.grid_sample(masks, grid, align_corners=False)
            reduced.append(F.avg_pool2d(masks, MASK_SIZE // SIZE).flatten(1))
    return torch.cat(reduced)
