"""Every figure of the paper's tables, as printed (Peng et al. 2020), by table, row and category.

Categories have the names of this package: the paper's "Dresser" is ShapeNet's cabinet. A row without values is one of
which the paper gives the mean alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Metric = Literal["kato18", "kato19", "unknown", "mmd"]

#: The 13 categories, in the order of the paper's columns.
CATEGORIES = (
    "airplane", "bench", "cabinet", "car", "chair", "display", "lamp",
    "loudspeaker", "rifle", "sofa", "table", "telephone", "vessel",
)  # fmt: skip


@dataclass(frozen=True)
class PublishedRow:
    """One row of a published table."""

    mean: float | None  # as printed; None where the paper prints "n/a"
    values: dict[str, float] = field(default_factory=dict)  # by category, as printed
    metric: Metric = "kato18"  # which voxeliser an IoU was measured with, or the MMD
    quoted_from: str | None = None  # the paper took the row from here; None: its authors measured it
    note: str | None = None


def _row(*figures: float, mean: float | None, **about: object) -> PublishedRow:
    return PublishedRow(mean, dict(zip(CATEGORIES, figures, strict=True)), **about)


_VPL_PAPER = "Kato and Harada 2019"

#: Voxel IoU on Kato's data, each view on its own; final networks of 20,000 iterations.
KATO = {
    "Vanilla-AE": _row(
        0.318, 0.304, 0.377, 0.534, 0.233, 0.267, 0.378,
        0.287, 0.333, 0.390, 0.375, 0.376, 0.475, mean=0.357,
    ),
    "VPL": _row(
        0.533, 0.367, 0.666, 0.635, 0.386, 0.500, 0.330,
        0.576, 0.356, 0.558, 0.416, 0.670, 0.453, mean=0.496,
    ),
    "Proposed": _row(
        0.565, 0.410, 0.661, 0.670, 0.415, 0.532, 0.378,
        0.434, 0.533, 0.592, 0.417, 0.684, 0.528, mean=0.524,
    ),
}  # fmt: skip

#: The same of Kato's own training on two views of each object: what supervision by pairs is worth.
MULTI_VIEW = {
    "Vanilla-AE (two views)": PublishedRow(
        0.603, quoted_from="Kato et al. 2018", note="in that paper; the released networks have .599"
    )
}

#: Voxel IoU of PrGAN with an encoder trained afterwards, on three categories of Kato's data.
PRGAN = {
    "PrGAN": PublishedRow(0.164, {"airplane": 0.151, "car": 0.228, "chair": 0.114}),
    "Proposed": PublishedRow(0.550, {"airplane": 0.565, "car": 0.670, "chair": 0.415}),
}

#: Voxel IoU on Kar's data, one view per training object, networks with the best validation IoU. The two quoted rows
#: were measured with another voxeliser (kato19) than the paper's own (kato18).
KAR = {
    "Vanilla-AE": _row(
        0.479, 0.266, 0.466, 0.550, 0.367, 0.265, 0.454,
        0.524, 0.382, 0.367, 0.342, 0.337, 0.439, mean=0.403, metric="kato19", quoted_from=_VPL_PAPER,
    ),
    "VPL": _row(
        0.513, 0.376, 0.591, 0.701, 0.444, 0.425, 0.422,
        0.596, 0.479, 0.500, 0.436, 0.595, 0.485, mean=0.505, metric="kato19", quoted_from=_VPL_PAPER,
        note="with internal pressure and class conditioning, without texture",
    ),
    "Proposed": _row(
        0.528, 0.360, 0.569, 0.742, 0.433, 0.423, 0.378,
        0.528, 0.542, 0.537, 0.384, 0.624, 0.505, mean=0.504,
    ),
}  # fmt: skip

_COMMENTED = "the paper prints the mean only; the figures by category stand commented out in its source"

#: Voxel IoU on Kato's data with one loss term off at a time.
ABLATION = {
    "Proposed": KATO["Proposed"],
    "w/o prior": _row(
        0.552, 0.350, 0.581, 0.680, 0.313, 0.508, 0.385,
        0.500, 0.519, 0.583, 0.413, 0.687, 0.515, mean=0.507, note=_COMMENTED,
    ),
    "w/o adversarial": _row(
        0.403, 0.371, 0.553, 0.572, 0.329, 0.369, 0.376,
        0.335, 0.352, 0.500, 0.385, 0.435, 0.475, mean=0.420, note=_COMMENTED,
    ),
    "w/o smoothness": _row(
        0.559, 0.386, 0.666, 0.654, 0.401, 0.543, 0.410,
        0.618, 0.588, 0.628, 0.385, 0.723, 0.476, mean=0.541, note=_COMMENTED,
    ),
}  # fmt: skip

#: Mean voxel IoU over the 13 categories of Kar's data, by widths of the view bins in azimuth and elevation.
BINS = {
    "60x60": PublishedRow(0.497),
    "30x30": PublishedRow(0.499),
    "20x20": PublishedRow(0.501),
    "20x15": PublishedRow(0.500),
    "15x20": PublishedRow(0.504),
    "15x15": PublishedRow(0.498),
    "10x10": PublishedRow(0.490),
}

#: MMD between the shape codes of views, mean over 276 pairs. The figures are those of the published code (five
#: kernels, no root), not of the printed formula, which cannot exceed sqrt(2).
MMD = {
    "Vanilla-AE": _row(
        1.825, 2.389, 0.737, 4.040, 1.240, 1.488, 0.018,
        0.647, 2.385, 2.309, 0.521, 2.306, 1.848, mean=1.673, metric="mmd",
    ),
    "Proposed": _row(
        0.272, 0.382, 0.051, 0.990, 0.106, 0.152, 0.014,
        0.079, 0.249, 0.173, 0.033, 0.298, 0.639, mean=0.264, metric="mmd",
    ),
}  # fmt: skip

#: Voxel IoU on Pascal3D+ (files of Kato and Harada 2019), mean over five runs. VPL's figures are of kato19; which
#: voxeliser CSDM's and CMR's belong to is not known.
PASCAL = {
    "CSDM": PublishedRow(
        0.429, {"airplane": 0.398, "car": 0.600, "chair": 0.291}, quoted_from="Kar et al. 2015", metric="unknown"
    ),
    "CMR": PublishedRow(
        None, {"airplane": 0.46, "car": 0.64}, quoted_from="Kanazawa et al. 2018", metric="unknown"
    ),
    "VPL": PublishedRow(
        0.488, {"airplane": 0.472, "car": 0.689, "chair": 0.303}, quoted_from=_VPL_PAPER, metric="kato19",
        note="without texture",
    ),
    "Baseline": PublishedRow(0.453, {"airplane": 0.423, "car": 0.672, "chair": 0.265}),
    "Proposed": PublishedRow(0.477, {"airplane": 0.458, "car": 0.695, "chair": 0.277}),
}  # fmt: skip
