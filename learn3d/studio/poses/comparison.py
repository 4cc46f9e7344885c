"""Compares estimated azimuths with the true ones of a data set."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from learn3d.data.dataset import ViewDataset
from learn3d.data.poses import wrap_deg
from learn3d.studio.poses.estimate import NEAR_DEG
from learn3d.studio.poses.views import EstimatedViews, number_objects


@dataclass(frozen=True)
class Comparison:
    """Errors of the estimated azimuths, after the whole frame was turned by `offset_deg`."""

    offset_deg: float
    accuracy: float  # Acc@30: share of errors of at most 30 degrees
    # the same, if half a turn does not count: many tables look the same from behind
    half_turn_accuracy: float
    median_deg: float
    mean_deg: float
    flips: float  # share of errors of at least 150 degrees
    objects_flipped: float  # share of the objects with flips in most of their images
    # mean confidence, accuracy and number of images, by confidence
    calibration: tuple[tuple[float, float, int], ...]

    def text(self) -> str:
        """Lines for the terminal."""
        lines = [
            f"against the data's azimuths (frame turned by {self.offset_deg:g} degrees): Acc@30 {self.accuracy:.3f}, "
            f"up to half a turn {self.half_turn_accuracy:.3f}, median error {self.median_deg:.1f}, "
            f"mean {self.mean_deg:.1f} degrees, flips {self.flips:.3f}, "
            f"objects flipped as a whole {self.objects_flipped:.3f}"
        ]
        return "\n".join(
            lines
            + [f"confidence {c:.2f}: Acc@30 {a:.2f} ({n} images)" for c, a, n in self.calibration]
        )


def check_true_poses(datasets: Sequence[ViewDataset]) -> None:
    """Raise a ValueError if a data set has no poses to compare with."""
    if any(dataset.poses is None for dataset in datasets):
        raise ValueError("--compare needs true poses, but this data set has none")


def compare(views: EstimatedViews) -> Comparison:
    """Compare the most probable azimuths with the true ones.

    The frame is turned by the whole number of degrees with the smallest sum of two mean errors,
    over all images but those of the test split: that of the azimuths, and that up to half a turn,
    which alone decides for objects that look the same from front and back. Raises ValueError if
    the data set has no poses.
    """
    check_true_poses(views.datasets)
    true = torch.cat([dataset.poses.azimuth_deg for dataset in views.datasets])
    found = torch.from_numpy(views.table.azimuth_deg[:, 0])
    chosen = torch.cat(
        [torch.full((len(dataset),), dataset.split != "test") for dataset in views.datasets]
    )
    offsets = torch.arange(360.0)
    turned = (wrap_deg(found[chosen] + o - true[chosen]).abs() for o in offsets)
    offset = float(
        offsets[torch.stack([(e + _up_to_half_turn(e)).mean() for e in turned]).argmin()]
    )
    errors = wrap_deg(found + offset - true).abs()[views.shown]
    flips = (errors >= 150).double()
    _, which = number_objects(views.datasets)[views.shown].unique(return_inverse=True)
    by_object = torch.bincount(which, flips) / torch.bincount(which)
    right = (errors <= NEAR_DEG).double()
    confidence = views.result.confidence.double()
    bins = [torch.nonzero((10 * confidence).floor().clamp(max=9) == k)[:, 0] for k in range(10)]
    calibration = tuple(
        (float(confidence[b].mean()), float(right[b].mean()), len(b)) for b in bins if len(b)
    )
    up_to_half_turn = (_up_to_half_turn(errors) <= NEAR_DEG).double()
    return Comparison(
        offset_deg=offset,
        accuracy=float(right.mean()),
        half_turn_accuracy=float(up_to_half_turn.mean()),
        median_deg=float(errors.median()),
        mean_deg=float(errors.mean()),
        flips=float(flips.mean()),
        objects_flipped=float((by_object > 0.5).double().mean()),
        calibration=calibration,
    )


def _up_to_half_turn(errors: Tensor) -> Tensor:
    return torch.minimum(errors, 180 - errors)
