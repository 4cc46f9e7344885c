"""The figures of the paper's tables, as printed (Peng et al. 2020), by table and row.

Categories have the names of this package: the paper's "Dresser" is ShapeNet's cabinet.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

Metric = Literal["kato18", "kato19", "unknown", "mmd"]

#: The 13 categories, in the order of the paper's columns.
CATEGORIES = tuple(
    "airplane bench cabinet car chair display lamp loudspeaker rifle sofa table telephone vessel".split()
)


@dataclass(frozen=True)
class PublishedRow:
    """One row of a published table."""

    mean: float | None  # as printed; None if the paper prints "n/a"
    values: dict[str, float] = field(default_factory=dict)  # by category, as printed; {} if only the mean is printed
    metric: Metric = "kato18"  # the voxeliser of an IoU, or the MMD
    quoted_from: str | None = None  # source of a row that the paper quotes; None if its authors measured it
    note: str | None = None


def _row(figures: str, **about: Any) -> PublishedRow:
    """A row from the figures of the 13 categories and their mean, separated by spaces."""
    *values, mean = map(float, figures.split())
    return PublishedRow(mean, dict(zip(CATEGORIES, values, strict=True)), **about)


_VPL_PAPER = "Kato and Harada 2019"

#: Table 1: voxel IoU on Kato's data after 20,000 iterations.
KATO = {
    "Vanilla-AE": _row(".318 .304 .377 .534 .233 .267 .378 .287 .333 .390 .375 .376 .475  .357"),
    "VPL": _row(".533 .367 .666 .635 .386 .500 .330 .576 .356 .558 .416 .670 .453  .496"),
    "Proposed": _row(".565 .410 .661 .670 .415 .532 .378 .434 .533 .592 .417 .684 .528  .524"),
}
_TWO_VIEWS = PublishedRow(0.603, quoted_from="Kato et al. 2018", note="in that paper; the released networks have .599")
#: Kato's own training on two views of each object is an upper bound for training on single views.
MULTI_VIEW = {name: KATO[name] for name in ("Vanilla-AE", "Proposed")} | {"Vanilla-AE (two views)": _TWO_VIEWS}

#: Table 2: PrGAN with an encoder that is trained afterwards.
PRGAN = {
    "PrGAN": PublishedRow(0.164, {"airplane": 0.151, "car": 0.228, "chair": 0.114}),
    "Proposed": PublishedRow(0.550, {"airplane": 0.565, "car": 0.670, "chair": 0.415}),
}

#: Table 3: voxel IoU on Kar's data, one view per training object, networks with the best validation IoU. The two quoted
#: rows were measured with another voxeliser (kato19) than the paper's own (kato18).
KAR = {
    "Vanilla-AE": _row(
        ".479 .266 .466 .550 .367 .265 .454 .524 .382 .367 .342 .337 .439  .403",
        metric="kato19",
        quoted_from=_VPL_PAPER,
    ),
    "VPL": _row(
        ".513 .376 .591 .701 .444 .425 .422 .596 .479 .500 .436 .595 .485  .505",
        metric="kato19",
        quoted_from=_VPL_PAPER,
        note="with internal pressure and class conditioning, without texture",
    ),
    "Proposed": _row(".528 .360 .569 .742 .433 .423 .378 .528 .542 .537 .384 .624 .505  .504"),
}

_COMMENTED = "the paper prints the mean only; the figures by category are commented out in its source"
#: Table 4: voxel IoU on Kato's data with one loss term off at a time.
ABLATION = {
    "Proposed": KATO["Proposed"],
    "w/o prior": _row(".552 .350 .581 .680 .313 .508 .385 .500 .519 .583 .413 .687 .515  .507", note=_COMMENTED),
    "w/o adversarial": _row(".403 .371 .553 .572 .329 .369 .376 .335 .352 .500 .385 .435 .475  .420", note=_COMMENTED),
    "w/o smoothness": _row(".559 .386 .666 .654 .401 .543 .410 .618 .588 .628 .385 .723 .476  .541", note=_COMMENTED),
}

#: Table 5: mean voxel IoU over the categories of Kar's data, by widths of the view bins in azimuth and elevation.
BINS = {"60x60": 0.497, "30x30": 0.499, "20x20": 0.501, "20x15": 0.500, "15x20": 0.504, "15x15": 0.498, "10x10": 0.490}

#: Table 6: MMD between the shape codes of views, mean over 276 pairs. The figures are those of the published code (five
#: kernels, no root), not of the printed formula, which cannot exceed sqrt(2).
MMD = {
    "Vanilla-AE": _row(
        "1.825 2.389 .737 4.040 1.240 1.488 .018 .647 2.385 2.309 .521 2.306 1.848  1.673", metric="mmd"
    ),
    "Proposed": _row(".272 .382 .051 .990 .106 .152 .014 .079 .249 .173 .033 .298 .639  .264", metric="mmd"),
}

#: Table 7: voxel IoU on Pascal3D+ (files of Kato and Harada 2019), mean over five runs. The voxeliser of CSDM's and
#: CMR's figures is not known.
PASCAL = {
    "CSDM": PublishedRow(0.429, {"airplane": 0.398, "car": 0.600, "chair": 0.291}, "unknown", "Kar et al. 2015"),
    "CMR": PublishedRow(None, {"airplane": 0.46, "car": 0.64}, "unknown", "Kanazawa et al. 2018"),
    "VPL": PublishedRow(
        0.488, {"airplane": 0.472, "car": 0.689, "chair": 0.303}, "kato19", _VPL_PAPER, note="without texture"
    ),
    "Baseline": PublishedRow(0.453, {"airplane": 0.423, "car": 0.672, "chair": 0.265}),
    "Proposed": PublishedRow(0.477, {"airplane": 0.458, "car": 0.695, "chair": 0.277}),
}
