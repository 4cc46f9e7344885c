"""What each table of the paper consists of: rows (a preset and what is changed in it), categories, the figures to meet.

A new table is a new entry of `TABLES`. Rows that several tables share have the same variant and so the same runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from learn3d.data.layouts import Layout
from learn3d.experiments import published
from learn3d.experiments.published import CATEGORIES, PublishedRow
from learn3d.methods.plus import PlusSettings
from learn3d.presets import METHODS


@dataclass(frozen=True)
class Variant:
    """A method as it is trained: what a run is named after and how its configuration comes about."""

    name: str  # first part of the run folder's name; the same name means the same runs, in every table
    preset: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # by name of a method's setting or a training option
    checkpoint: Literal["last", "best"] = "last"  # which networks are tested: final, or best on the validation split
    smaller_batches: int = 1  # batches divided by this and steps multiplied by it, so that the images are as many
    whole: str = ""  # the preset whose batches and steps these are; "": its own


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    label: str
    variant: Variant | None  # None: a quoted row, never trained here
    published: PublishedRow | None = None


@dataclass(frozen=True)
class Table:
    """One table of the paper."""

    name: str
    title: str
    metric: Literal["iou", "mmd"]  # what stands in it
    rows: tuple[Row, ...]
    baseline: str  # label of the row that differences are taken to
    layout: Layout = "kato"
    categories: tuple[str, ...] = CATEGORIES
    seeds: int = 1
    note: str = ""

    @property
    def variants(self) -> tuple[Variant, ...]:
        """What is trained for it."""
        return tuple(row.variant for row in self.rows if row.variant is not None)


_BATCHES = 4  # Plus learns from a quarter of the images a step, in four times the steps


def _plus(name: str, data: str, changes: Mapping[str, Any] | None = None, **options: Any) -> Variant:
    """Plus on the images that the paper's preset for these data sees."""
    return Variant(name, f"plus-{data}", changes or {}, smaller_batches=_BATCHES, whole=f"peng2020-{data}", **options)


PROPOSED, VANILLA, MULTI_VIEW, VPL, PRGAN = (
    Variant(name, METHODS[name]) for name in ("proposed", "vanilla", "multi-view", "vpl", "prgan")
)
PLUS = _plus("plus", "kato")

_NO_PRIOR = Variant("without-prior", "peng2020-kato", {"lambda_prior": 0.0})
#: Without the confusion loss the discriminator has no effect on the encoder, so its own loss is off, too.
_NO_ADVERSARIAL = Variant(
    "without-adversarial", "peng2020-kato", {"lambda_adversarial": 0.0, "lambda_classification": 0.0}
)
_NO_SMOOTHNESS = Variant("without-smoothness", "peng2020-kato", {"lambda_smooth": 0.0})
_FP32 = Variant("proposed-fp32", "peng2020-kato", {"precision": "fp32"})
_BF16 = Variant("proposed-bf16", "peng2020-kato", {"precision": "bf16"})


def _bins(widths: str) -> Variant:
    return Variant(f"bins-{widths}", "peng2020-kar", {"view_bins": widths}, checkpoint="best")


_KAR_VANILLA = Variant("kar-vanilla", "peng2020-kar-vanilla", checkpoint="best")
_KAR_VPL = Variant("kar-vpl", "kato2019-kar", checkpoint="best")
_KAR_PLUS = _plus("kar-plus", "kar", checkpoint="best")
_PASCAL_PROPOSED = Variant("pascal-proposed", "peng2020-pascal", checkpoint="best")
_PASCAL_BASELINE = Variant("pascal-baseline", "peng2020-pascal-vanilla", checkpoint="best")
_PASCAL_VPL = Variant("pascal-vpl", "kato2019-pascal")
_PASCAL_PLUS = _plus("pascal-plus", "pascal", checkpoint="best")

#: What Plus has and any method can have: its learning-rate schedule, its average of the weights, its symmetry.
_OF_PLUS = PlusSettings()
_SCHEDULE = {"lr_schedule": "cosine", "warmup_steps": 100, "ema_decay": 0.99, "learning_rate": _OF_PLUS.learning_rate}
_SYMMETRY = {"symmetry": "auto"}
_VANILLA_BOTH = Variant("vanilla-schedule-symmetry", "peng2020-kato-vanilla", _SCHEDULE | _SYMMETRY)
_PROPOSED_SCHEDULE = Variant("proposed-schedule", "peng2020-kato", _SCHEDULE)
_PROPOSED_BOTH = Variant("proposed-schedule-symmetry", "peng2020-kato", _SCHEDULE | _SYMMETRY)
_SHARED = _SCHEDULE | _SYMMETRY
_SHARED |= {
    name: getattr(_OF_PLUS, name) for name in ("encoder", "clamp_to_cube", "lambda_smooth", "lambda_smooth_end")
}
_PROPOSED_SHARED = Variant("proposed-shared", "peng2020-kato", _SHARED, smaller_batches=_BATCHES)
_VANILLA_SHARED = Variant("vanilla-shared", "peng2020-kato-vanilla", _SHARED, smaller_batches=_BATCHES)
_PLUS_FREE = _plus("plus-without-symmetry", "kato", {"symmetry": None})
_PLUS_SEEN = _plus("plus-without-novel-views", "kato", {"lambda_novel_view": 0.0})
_ONE_VIEW = {"views_per_object": 1}
_SINGLE_VANILLA = Variant("single-vanilla", "peng2020-kato-vanilla", _ONE_VIEW)
_SINGLE_PROPOSED = Variant("single-proposed", "peng2020-kato", _ONE_VIEW)
_SINGLE_PLUS = _plus("single-plus", "kato", _ONE_VIEW)

_THREE = ("airplane", "car", "chair")

#: The tables of the paper, and four that are not in it: multi-view, two of Plus, precision.
_ALL = (
    Table(
        "kato",
        "Voxel IoU on Kato's data (Table 1)",
        "iou",
        (
            Row("Vanilla-AE", VANILLA, published.KATO["Vanilla-AE"]),
            Row("VPL", VPL, published.KATO["VPL"]),
            Row("Proposed", PROPOSED, published.KATO["Proposed"]),
        ),
        baseline="Vanilla-AE",
    ),
    Table(
        "prgan",
        "Comparison with PrGAN, voxel IoU on Kato's data (Table 2)",
        "iou",
        (Row("PrGAN", PRGAN, published.PRGAN["PrGAN"]), Row("Proposed", PROPOSED, published.PRGAN["Proposed"])),
        baseline="PrGAN",
        categories=_THREE,
    ),
    Table(
        "kar",
        "Voxel IoU on Kar's data, continuous viewpoints (Table 3)",
        "iou",
        (
            Row("Vanilla-AE", _KAR_VANILLA, published.KAR["Vanilla-AE"]),
            Row("VPL", _KAR_VPL, published.KAR["VPL"]),
            Row("Proposed", _bins("15x20"), published.KAR["Proposed"]),
            Row("Plus", _KAR_PLUS),
        ),
        baseline="Vanilla-AE",
        layout="kar",
        note="VPL is trained here on each category by itself; its quoted figures are of one model of all 13.",
    ),
    Table(
        "ablation",
        "One loss term off at a time, voxel IoU on Kato's data (Table 4)",
        "iou",
        (
            Row("Proposed", PROPOSED, published.ABLATION["Proposed"]),
            Row("w/o prior", _NO_PRIOR, published.ABLATION["w/o prior"]),
            Row("w/o adversarial", _NO_ADVERSARIAL, published.ABLATION["w/o adversarial"]),
            Row("w/o smoothness", _NO_SMOOTHNESS, published.ABLATION["w/o smoothness"]),
        ),
        baseline="Proposed",
    ),
    Table(
        "bins",
        "Number of view bins, voxel IoU on Kar's data (Table 5)",
        "iou",
        tuple(Row(f"{widths} degrees", _bins(widths), figure) for widths, figure in published.BINS.items()),
        baseline="15x20 degrees",
        layout="kar",
        note="Bins are widths of azimuth x elevation; K is their number over 360 x 60 degrees.",
    ),
    Table(
        "mmd",
        "MMD between the shape codes of different views on Kato's data (Table 6); lower is better",
        "mmd",
        (
            Row("Vanilla-AE", VANILLA, published.MMD["Vanilla-AE"]),
            Row("Proposed", PROPOSED, published.MMD["Proposed"]),
        ),
        baseline="Vanilla-AE",
        note="The mean over all pairs of views (276 of 24), as in the published code: five kernels, no root. "
        "The detailed table has the printed formula (one kernel, square root) too.",
    ),
    Table(
        "multi-view",
        "Upper bound: Kato's own training on pairs of views, voxel IoU on his data (no table of the paper)",
        "iou",
        (
            Row("Vanilla-AE", VANILLA, published.KATO["Vanilla-AE"]),
            Row("Proposed", PROPOSED, published.KATO["Proposed"]),
            Row("Vanilla-AE (two views)", MULTI_VIEW, published.MULTI_VIEW["Vanilla-AE (two views)"]),
        ),
        baseline="Vanilla-AE",
    ),
    Table(
        "pascal",
        "Voxel IoU on Pascal3D+, mean of five runs (Table 7)",
        "iou",
        (
            Row("CSDM", None, published.PASCAL["CSDM"]),
            Row("CMR", None, published.PASCAL["CMR"]),
            Row("VPL", _PASCAL_VPL, published.PASCAL["VPL"]),
            Row("Baseline", _PASCAL_BASELINE, published.PASCAL["Baseline"]),
            Row("Proposed", _PASCAL_PROPOSED, published.PASCAL["Proposed"]),
            Row("Plus", _PASCAL_PLUS),
        ),
        baseline="Baseline",
        layout="pascal3d",
        categories=_THREE,
        seeds=5,
        note="The data set has no third split: as in the paper, networks are chosen and measured on the same images.",
    ),
    Table(
        "plus",
        "What Plus adds to the proposed method, voxel IoU on Kato's data (no table of the paper)",
        "iou",
        (
            Row("Vanilla-AE", VANILLA),
            Row("Vanilla-AE, schedule and symmetry", _VANILLA_BOTH),
            Row("Proposed", PROPOSED),
            Row("Proposed, schedule", _PROPOSED_SCHEDULE),
            Row("Proposed, schedule and symmetry", _PROPOSED_BOTH),
            Row("Vanilla-AE, all that is shared", _VANILLA_SHARED),
            Row("Proposed, all that is shared", _PROPOSED_SHARED),
            Row("Plus, w/o novel views", _PLUS_SEEN),
            Row("Plus, w/o symmetry", _PLUS_FREE),
            Row("Plus", PLUS),
        ),
        baseline="Proposed",
        categories=("airplane", "chair", "table"),
        seeds=3,
        note="Schedule: the learning-rate schedule and the EMA of Plus. Shared: also its symmetry, its "
        "encoder, its smoothness, and its batches, a quarter of the others' in four times the steps (as many images).",
    ),
    Table(
        "plus-single",
        "The same with one image of every object, voxel IoU on Kato's data (no table of the paper)",
        "iou",
        (Row("Vanilla-AE", _SINGLE_VANILLA), Row("Proposed", _SINGLE_PROPOSED), Row("Plus", _SINGLE_PLUS)),
        baseline="Proposed",
        categories=("airplane", "chair"),
        seeds=3,
        note="Kato's data show each object from 24 sides, which a method may notice; here no object is seen twice, "
        "except that scaled copies of a mesh count as objects.",
    ),
    Table(
        "precision",
        "Networks in bf16 against fp32, voxel IoU on Kato's data (no table of the paper)",
        "iou",
        (Row("Proposed, fp32", _FP32), Row("Proposed, bf16", _BF16)),
        baseline="Proposed, fp32",
        categories=("airplane", "chair"),
        seeds=3,
        note="Runs of the same seed begin with the same weights and see the same images; rendering and losses are fp32 "
        "in both.",
    ),
)

TABLES: dict[str, Table] = {table.name: table for table in _ALL}
