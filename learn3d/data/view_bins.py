"""From continuous viewpoints to the K pose classes that the discriminator tells apart."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from learn3d.data.poses import LookAtPoses, wrap_deg
from learn3d.files import limits
from learn3d.settings import Positive, checked


@checked
class AngleBins:
    """Cells of equal width in azimuth and elevation, K = azimuth cells x elevation cells (paper, table of bins).

    Cell = floor((azimuth + 180) / w) * n_el + floor((elevation - low) / h), as in the published code; angles on or
    beyond the upper end count as the last cell.
    """

    azimuth_width_deg: Annotated[float, Field(gt=0, le=360)]
    elevation_width_deg: Positive
    elevation_low_deg: Annotated[float, Field(ge=-90, le=90)] = -20.0  # Kar's range of elevations is -20 .. 40
    elevation_high_deg: Annotated[float, Field(ge=-90, le=90)] = 40.0

    def __post_init__(self) -> None:
        span = self.elevation_high_deg - self.elevation_low_deg
        if span <= 0:
            raise ValueError(
                f"elevations must go from low to high, got {self.elevation_low_deg} .. {self.elevation_high_deg}"
            )
        cells = 360 / self.azimuth_width_deg * (span / self.elevation_width_deg)
        if cells > limits.VIEW_CLASSES:
            raise ValueError(f"there would be {cells:.0f} bins; at most {limits.VIEW_CLASSES} are possible")

    @classmethod
    def parse(cls, text: str) -> AngleBins:
        """From "15x20" (azimuth x elevation widths in degrees), or "15x20:-20:40" with the range of elevations."""
        try:
            widths, *limits = text.split(":")
            azimuth, elevation = (float(width) for width in widths.split("x"))
            low, high = (float(limit) for limit in limits) if limits else (-20.0, 40.0)
        except ValueError:
            raise ValueError(
                f"view bins are written as AZIMUTHxELEVATION in degrees, such as 15x20 or 15x20:-20:40, got {text!r}"
            ) from None
        return cls(azimuth, elevation, low, high)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells in azimuth and in elevation."""
        azimuth = int(np.ceil(360 / self.azimuth_width_deg - 1e-9))
        span = self.elevation_high_deg - self.elevation_low_deg
        return azimuth, max(1, int(np.ceil(span / self.elevation_width_deg - 1e-9)))

    @property
    def count(self) -> int:
        """K."""
        return self.shape[0] * self.shape[1]

    def ids(self, poses: LookAtPoses) -> Tensor:
        """The class of every pose, int64 [M] in 0 .. K-1."""
        azimuths, elevations = self.shape
        azimuth = poses.azimuth_deg.double()
        turn = torch.where(azimuth == 180, azimuth, wrap_deg(azimuth)) + 180  # the upper end belongs to the last cell
        a = (turn / self.azimuth_width_deg).floor().long().clamp(0, azimuths - 1)
        e = (poses.elevations_deg.double() - self.elevation_low_deg) / self.elevation_width_deg
        return a * elevations + e.floor().long().clamp(0, elevations - 1)

    def names(self) -> list[str]:
        """What to call each class, by the middle of its cell."""
        azimuths, elevations = self.shape
        middle_a = [-180 + (k + 0.5) * self.azimuth_width_deg for k in range(azimuths)]
        middle_e = [self.elevation_low_deg + (k + 0.5) * self.elevation_width_deg for k in range(elevations)]
        return [f"azimuth {a:g}°, elevation {e:g}°" for a in middle_a for e in middle_e]
