"""Maps continuous viewpoints to the K view classes of a discriminator."""

from __future__ import annotations

import math
import re
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

import nmr
from learn3d.data.poses import LookAtPoses, wrap_deg
from learn3d.files import limits
from learn3d.settings import Positive, checked

AZIMUTH_WIDTHS_DEG = (15, 20, 30, 45, 60, 90)
ELEVATION_WIDTH_DEG = 20
IMAGES_PER_CLASS = 8  # smallest mean number of images per view class


@checked
class AngleBins:
    """Cells of equal width in azimuth and elevation, K = azimuth cells x elevation cells (paper,
    table of bins).

    Cell = floor((azimuth + 180) / w) * n_el + floor((elevation - low) / h), as in the published
    code. Angles beyond the range are clamped to the first or last cell.
    """

    azimuth_width_deg: Annotated[float, Field(gt=0, le=360)]
    elevation_width_deg: Positive
    elevation_low_deg: Annotated[
        float, Field(ge=-90, le=90)
    ] = -20.0  # Kar's range of elevations is -20 .. 40
    elevation_high_deg: Annotated[float, Field(ge=-90, le=90)] = 40.0

    def __post_init__(self) -> None:
        span = self.elevation_high_deg - self.elevation_low_deg
        if span <= 0:
            limits_deg = f"{self.elevation_low_deg} .. {self.elevation_high_deg}"
            raise ValueError(f"elevations must go from low to high, got {limits_deg}")
        cells = 360 / self.azimuth_width_deg * (span / self.elevation_width_deg)
        if cells > limits.VIEW_CLASSES:
            raise ValueError(
                f"there would be {cells:.0f} bins; at most {limits.VIEW_CLASSES} are possible"
            )

    @classmethod
    def parse(cls, text: str) -> AngleBins:
        """From "15x20" (azimuth x elevation widths in degrees), or "15x20:-20:40" with a range of
        elevations.
        """
        number = r"(-?\d+(?:\.\d+)?)"
        if not (match := re.fullmatch(f"{number}x{number}(?::{number}:{number})?", text)):
            wanted = "AZIMUTHxELEVATION in degrees, such as 15x20 or 15x20:-20:40"
            raise ValueError(f"view bins are written as {wanted}, got {text!r}")
        return cls(*(float(value) for value in match.groups() if value is not None))

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells in azimuth and in elevation."""
        azimuth = int(np.ceil(360 / self.azimuth_width_deg - 1e-9))
        span = self.elevation_high_deg - self.elevation_low_deg
        return azimuth, max(1, int(np.ceil(span / self.elevation_width_deg - 1e-9)))

    def ids(self, poses: LookAtPoses) -> Tensor:
        """The class of every pose, int64 [M] in 0 .. K-1."""
        azimuths, elevations = self.shape
        azimuth = poses.azimuth_deg.double()
        # the upper end belongs to the last cell
        turn = torch.where(azimuth == 180, azimuth, wrap_deg(azimuth)) + 180
        a = (turn / self.azimuth_width_deg).floor().long().clamp(0, azimuths - 1)
        elevation = torch.as_tensor(poses.elevation_deg, dtype=torch.float32).double()
        e = (
            ((elevation - self.elevation_low_deg) / self.elevation_width_deg)
            .floor()
            .long()
            .clamp(0, elevations - 1)
        )
        return a * elevations + e

    def names(self) -> list[str]:
        """The K names of the classes: the middles of their cells."""
        azimuths, elevations = self.shape
        middle_a = [-180 + (k + 0.5) * self.azimuth_width_deg for k in range(azimuths)]
        middle_e = [
            self.elevation_low_deg + (k + 0.5) * self.elevation_width_deg for k in range(elevations)
        ]
        return [f"azimuth {a:g}°, elevation {e:g}°" for a in middle_a for e in middle_e]


def training_classes(
    views: tuple[np.ndarray, np.ndarray], training: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Class of each view, int64 [M] below K, and the cells int64 [K] of the classes: those with
    training views.

    views: their cells int64 [M] and directions float [M, D]. training: those of the training
    views. A view in another cell gets the class of the training view with the nearest direction,
    that is the largest dot product.
    """
    cells = views[0].copy()
    unseen = ~np.isin(views[0], training[0])
    cells[unseen] = training[0][(views[1][unseen] @ training[1].T).argmax(axis=1)]
    kept = np.unique(training[0])
    return np.searchsorted(kept, cells), kept


def choose_bins(poses: LookAtPoses) -> AngleBins:
    """Cells of azimuth and elevation for images with these poses.

    The elevation width is about 20 degrees. The azimuth width is the smallest of
    AZIMUTH_WIDTHS_DEG for which occupied cells have IMAGES_PER_CLASS images or more on average.
    """
    elevations = torch.as_tensor(poses.elevation_deg)
    low = math.floor(float(elevations.min()))
    high = max(math.ceil(float(elevations.max())), low + 1)
    rows = max(1, round((high - low) / ELEVATION_WIDTH_DEG))
    for width in AZIMUTH_WIDTHS_DEG:
        bins = AngleBins(width, (high - low) / rows, low, high)
        if len(poses) >= IMAGES_PER_CLASS * len(bins.ids(poses).unique()):
            break
    return bins


def view_classes(poses: LookAtPoses, training: LookAtPoses) -> tuple[np.ndarray, tuple[str, ...]]:
    """Class int64 [M] in 0 .. K-1 of each of M poses, and the K names.

    Classes are the cells (`choose_bins`) with training poses. Another pose gets the class of the
    training pose with the nearest direction.
    """
    bins = choose_bins(training)
    names = bins.names()

    def describe(poses: LookAtPoses) -> tuple[np.ndarray, np.ndarray]:
        eyes = nmr.cameras.points_from_angles(1.0, poses.elevation_deg, poses.azimuth_deg)
        return bins.ids(poses).numpy(), eyes.numpy()

    ids, kept = training_classes(describe(poses), describe(training))
    return ids, tuple(names[k] for k in kept)
