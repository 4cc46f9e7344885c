"""The tables of the paper as data: rows (a preset and its changed options), categories, published figures.

A new table is a new entry of `TABLES`. Rows of several tables that name the same variant share their runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from learn3d.data.layouts import Layout
from learn3d.experiments import published
from learn3d.experiments.published import CATEGORIES, PublishedRow
from learn3d.methods.plus import PlusSettings
from learn3d.presets import full_name


@dataclass(frozen=True)
class Variant:
    """A preset with changes. Its name is that of its run folders, so equal names mean the same runs in every table."""

    preset: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # settings of the method and options of the training
    checkpoint: Literal["last", "best"] = "last"  # networks to test: the last ones, or the best on the validation split
    batch_divisor: int = 1  # divides the batch size and multiplies the iterations, so that as many images are seen
    length_of: str = ""  # preset whose batch size and iterations count; "" means its own


@dataclass(frozen=True)
class Table:
    """One table."""

    title: str
    rows: Mapping[str, str | None]  # label of a row -> name of its variant; None: a quoted row, never trained here
    baseline: str  # label of the row from which differences are taken
    published: Mapping[str, PublishedRow] = field(default_factory=dict)  # the paper's figures, by label
    metric: Literal["iou", "mmd"] = "iou"
    layout: Layout = "kato"
    categories: tuple[str, ...] = CATEGORIES
    seeds: int = 1
    note: str = ""


_PLUS = PlusSettings()
_BATCH_DIVISOR = 4  # a step of Plus sees a quarter of the other methods' images, and Plus takes four times the steps
_SCHEDULE = {"lr_schedule": "cosine", "warmup_steps": 100, "ema_decay": 0.99, "learning_rate": _PLUS.learning_rate}
_SYMMETRY = {"symmetry": "auto"}
_SHARED_NAMES = ("encoder", "clamp_to_cube", "lambda_smooth", "lambda_smooth_end")
_SHARED = _SCHEDULE | _SYMMETRY | {name: getattr(_PLUS, name) for name in _SHARED_NAMES}
_ONE_VIEW = {"views_per_object": 1}


def _plus(data: str, changes: Mapping[str, Any] | None = None, **options: Any) -> Variant:
    """Plus on as many images as the paper's preset for these data sees."""
    options |= {"batch_divisor": _BATCH_DIVISOR, "length_of": f"peng2020-{data}"}
    return Variant(f"plus-{data}", changes or {}, **options)


def _kato(changes: Mapping[str, Any], method: str = "proposed", **options: Any) -> Variant:
    return Variant(full_name(method), changes, **options)


#: By name. Without the confusion loss the discriminator has no effect on the encoder, so its own loss is off, too.
VARIANTS: dict[str, Variant] = {
    **{method: _kato({}, method) for method in ("proposed", "vanilla", "multi-view", "vpl", "prgan")},
    "plus": _plus("kato"),
    "without-prior": _kato({"lambda_prior": 0.0}),
    "without-adversarial": _kato({"lambda_adversarial": 0.0, "lambda_classification": 0.0}),
    "without-smoothness": _kato({"lambda_smooth": 0.0}),
    "proposed-fp32": _kato({"precision": "fp32"}),
    "proposed-bf16": _kato({"precision": "bf16"}),
    **{f"bins-{w}": Variant("peng2020-kar", {"view_bins": w}, "best") for w in published.BINS},
    "kar-vanilla": Variant("peng2020-kar-vanilla", checkpoint="best"),
    "kar-vpl": Variant("kato2019-kar", checkpoint="best"),
    "kar-plus": _plus("kar", checkpoint="best"),
    "pascal-proposed": Variant("peng2020-pascal", checkpoint="best"),
    "pascal-baseline": Variant("peng2020-pascal-vanilla", checkpoint="best"),
    "pascal-vpl": Variant("kato2019-pascal"),
    "pascal-plus": _plus("pascal", checkpoint="best"),
    "vanilla-schedule-symmetry": _kato(_SCHEDULE | _SYMMETRY, "vanilla"),
    "proposed-schedule": _kato(_SCHEDULE),
    "proposed-schedule-symmetry": _kato(_SCHEDULE | _SYMMETRY),
    "proposed-shared": _kato(_SHARED, batch_divisor=_BATCH_DIVISOR),
    "vanilla-shared": _kato(_SHARED, "vanilla", batch_divisor=_BATCH_DIVISOR),
    "plus-without-symmetry": _plus("kato", {"symmetry": None}),
    "plus-without-novel-views": _plus("kato", {"lambda_novel_view": 0.0}),
    "single-vanilla": _kato(_ONE_VIEW, "vanilla"),
    "single-proposed": _kato(_ONE_VIEW),
    "single-plus": _plus("kato", _ONE_VIEW),
}

_NOT_IN_THE_PAPER = "voxel IoU on Kato's data (no table of the paper)"
_THREE = ("airplane", "car", "chair")

#: By name: the tables of the paper, and four others (multi-view, plus, plus-single, precision).
TABLES: dict[str, Table] = {
    "kato": Table(
        "Voxel IoU on Kato's data (Table 1)",
        {"Vanilla-AE": "vanilla", "VPL": "vpl", "Proposed": "proposed"},
        "Vanilla-AE",
        published.KATO,
    ),
    "prgan": Table(
        "Comparison with PrGAN, voxel IoU on Kato's data (Table 2)",
        {"PrGAN": "prgan", "Proposed": "proposed"},
        "PrGAN",
        published.PRGAN,
        categories=_THREE,
    ),
    "kar": Table(
        "Voxel IoU on Kar's data, continuous viewpoints (Table 3)",
        {"Vanilla-AE": "kar-vanilla", "VPL": "kar-vpl", "Proposed": "bins-15x20", "Plus": "kar-plus"},
        "Vanilla-AE",
        published.KAR,
        layout="kar",
        note="VPL is trained here on each category by itself; its quoted figures are of one model of all 13.",
    ),
    "ablation": Table(
        "One loss term off at a time, voxel IoU on Kato's data (Table 4)",
        {
            "Proposed": "proposed",
            "w/o prior": "without-prior",
            "w/o adversarial": "without-adversarial",
            "w/o smoothness": "without-smoothness",
        },
        "Proposed",
        published.ABLATION,
    ),
    "bins": Table(
        "Number of view bins, voxel IoU on Kar's data (Table 5)",
        {f"{widths} degrees": f"bins-{widths}" for widths in published.BINS},
        "15x20 degrees",
        {f"{widths} degrees": PublishedRow(mean) for widths, mean in published.BINS.items()},
        layout="kar",
        note="Bins are widths of azimuth x elevation; K is their number over 360 x 60 degrees.",
    ),
    "mmd": Table(
        "MMD between the shape codes of different views on Kato's data (Table 6); lower is better",
        {"Vanilla-AE": "vanilla", "Proposed": "proposed"},
        "Vanilla-AE",
        published.MMD,
        metric="mmd",
        note="The mean over all pairs of views (276 of 24), as in the published code: five kernels, no root. "
        "The detailed table has the printed formula (one kernel, square root) too.",
    ),
    "multi-view": Table(
        f"Upper bound: Kato's own training on pairs of views, {_NOT_IN_THE_PAPER}",
        {"Vanilla-AE": "vanilla", "Proposed": "proposed", "Vanilla-AE (two views)": "multi-view"},
        "Vanilla-AE",
        published.MULTI_VIEW,
    ),
    "pascal": Table(
        "Voxel IoU on Pascal3D+, mean of five runs (Table 7)",
        {
            "CSDM": None,
            "CMR": None,
            "VPL": "pascal-vpl",
            "Baseline": "pascal-baseline",
            "Proposed": "pascal-proposed",
            "Plus": "pascal-plus",
        },
        "Baseline",
        published.PASCAL,
        layout="pascal3d",
        categories=_THREE,
        seeds=5,
        note="The data set has no third split: as in the paper, networks are chosen and measured on the same images.",
    ),
    "plus": Table(
        f"What Plus adds to the proposed method, {_NOT_IN_THE_PAPER}",
        {
            "Vanilla-AE": "vanilla",
            "Vanilla-AE, schedule and symmetry": "vanilla-schedule-symmetry",
            "Proposed": "proposed",
            "Proposed, schedule": "proposed-schedule",
            "Proposed, schedule and symmetry": "proposed-schedule-symmetry",
            "Vanilla-AE, all that is shared": "vanilla-shared",
            "Proposed, all that is shared": "proposed-shared",
            "Plus, w/o novel views": "plus-without-novel-views",
            "Plus, w/o symmetry": "plus-without-symmetry",
            "Plus": "plus",
        },
        "Proposed",
        categories=("airplane", "chair", "table"),
        seeds=3,
        note="Schedule: the learning-rate schedule and the EMA of the weights of Plus. Shared: also its symmetry, its "
        "encoder, smoothness and batches, a quarter of the others' in four times the steps (as many images).",
    ),
    "plus-single": Table(
        f"The same with one image of every object, {_NOT_IN_THE_PAPER}",
        {"Vanilla-AE": "single-vanilla", "Proposed": "single-proposed", "Plus": "single-plus"},
        "Proposed",
        categories=("airplane", "chair"),
        seeds=3,
        note="Kato's data show each object from 24 sides, which a method may notice; here no object is seen twice, "
        "except that scaled copies of a mesh count as objects.",
    ),
    "precision": Table(
        f"Networks in bf16 against fp32, {_NOT_IN_THE_PAPER}",
        {"Proposed, fp32": "proposed-fp32", "Proposed, bf16": "proposed-bf16"},
        "Proposed, fp32",
        categories=("airplane", "chair"),
        seeds=3,
        note="Runs of the same seed begin with the same weights and see the same images; rendering and losses are fp32 "
        "in both.",
    ),
}
