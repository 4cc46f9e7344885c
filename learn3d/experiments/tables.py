"""The tables of the paper (Peng et al. 2020) as data. Rows and printed figures are in tables.csv.

A new table is a new entry of `TABLES`, and a line of tables.csv for each row. Rows of several tables that name the same
variant share their runs. Categories have the names of this package: the paper's "Dresser" is ShapeNet's cabinet.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from learn3d.data.layouts import Layout
from learn3d.data.sampling import GROUP_SIZE
from learn3d.methods.plus import PlusSettings

#: The 13 categories, in the order of the paper's columns.
CATEGORIES = tuple(
    "airplane bench cabinet car chair display lamp loudspeaker rifle sofa table telephone vessel".split()
)
MEAN = "mean"  # the column after the categories
BATCH_DIVISOR = 4  # a step of Plus sees a quarter of the other methods' images, and Plus takes four times the steps


@dataclass(frozen=True)
class Variant:
    """A preset with changes. Its name is that of its run folders, so equal names mean the same runs in every table."""

    preset: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # settings of the method and options of the training
    checkpoint: Literal["last", "best"] = "last"  # networks to test: the last ones, or the best on the validation split
    small_batches_of: str = ""  # preset that sees as many images, in BATCH_DIVISOR times larger batches; "" for none
    batch_factor: int = 1  # multiplies the batch size, if a batch also has images that are not encoded
    estimates_poses: bool = False  # azimuths are estimated with the run's seed, and turned into the data's frame


class Row(NamedTuple):
    """One method in a table."""

    variant: str | None  # name in `VARIANTS`; None: a quoted row, never trained here
    about: str  # the voxelizer of the printed figures, and their source if they are quoted
    printed: dict[str, float]  # the paper's figures by category, and their "mean"; without those that it lacks


def read_rows() -> dict[str, dict[str, Row]]:
    """The rows of tables.csv, by table and label."""
    tables: dict[str, dict[str, Row]] = {}
    with open(Path(__file__).with_suffix(".csv"), encoding="utf-8", newline="") as file:
        for line in csv.DictReader(file):
            printed = {name: float(line[name]) for name in (*CATEGORIES, MEAN) if line[name]}
            row = Row(line["variant"] or None, line["source"], printed)
            tables.setdefault(line["experiment"], {})[line["method"]] = row
    return tables


_PLUS = PlusSettings()
_PROPOSED, _VANILLA = "peng2020-kato", "peng2020-kato-vanilla"
_SCHEDULE = {"lr_schedule": "cosine", "warmup_steps": 100, "ema_decay": 0.99, "learning_rate": _PLUS.learning_rate}
_SYMMETRY = {"symmetry": "auto"}
_SHARED_NAMES = ("encoder", "generator", "lambda_area", "clamp_to_cube", "lambda_smooth", "lambda_smooth_end")
_SHARED = _SCHEDULE | _SYMMETRY | {name: getattr(_PLUS, name) for name in _SHARED_NAMES}
#: Networks, smoothness and schedule of the table of supervision, whose methods encode as many images as Plus.
_SUPERVISION = _SCHEDULE | _SYMMETRY | {"encoder": "conv-light", "generator": "sphere", "clamp_to_cube": True}
_SUPERVISION |= {"lambda_smooth": 3e-4, "augment": ("colors",)}
_SMALL: dict[str, Any] = {"small_batches_of": _PROPOSED}
#: Widths of the view bins in azimuth and elevation, in degrees.
BINS = ("60x60", "30x30", "20x20", "20x15", "15x20", "15x15", "10x10")

#: By name. Without the confusion loss the discriminator has no effect on the encoder, so its own loss is off, too.
VARIANTS: dict[str, Variant] = {
    "proposed": Variant(_PROPOSED),
    "vanilla": Variant(_VANILLA),
    "vpl": Variant("peng2020-kato-vpl"),
    "prgan": Variant("gadelha2017-kato"),
    "plus": Variant("plus-kato", **_SMALL),
    "plus-estimated-poses": Variant("plus-kato", estimates_poses=True, **_SMALL),
    "without-prior": Variant(_PROPOSED, {"lambda_prior": 0.0}),
    "without-adversarial": Variant(_PROPOSED, {"lambda_adversarial": 0.0, "lambda_classification": 0.0}),
    "without-smoothness": Variant(_PROPOSED, {"lambda_smooth": 0.0}),
    **{f"bins-{widths}": Variant("peng2020-kar", {"view_bins": widths}, "best") for widths in BINS},
    "kar-vanilla": Variant("peng2020-kar-vanilla", checkpoint="best"),
    "kar-vpl": Variant("kato2019-kar", checkpoint="best"),
    "kar-plus": Variant("plus-kar", checkpoint="best", small_batches_of="peng2020-kar"),
    "pascal-proposed": Variant("peng2020-pascal", checkpoint="best"),
    "pascal-baseline": Variant("peng2020-pascal-vanilla", checkpoint="best"),
    "pascal-vpl": Variant("kato2019-pascal"),
    "pascal-plus": Variant("plus-pascal", checkpoint="best", small_batches_of="peng2020-pascal"),
    "vanilla-schedule-symmetry": Variant(_VANILLA, _SCHEDULE | _SYMMETRY),
    "proposed-schedule": Variant(_PROPOSED, _SCHEDULE),
    "proposed-schedule-symmetry": Variant(_PROPOSED, _SCHEDULE | _SYMMETRY),
    "proposed-shared": Variant(_PROPOSED, _SHARED, **_SMALL),
    "vanilla-shared": Variant(_VANILLA, _SHARED, **_SMALL),
    "single-views": Variant(_VANILLA, _SUPERVISION, **_SMALL),
    "pairs": Variant("kato2018-kato", _SUPERVISION, **_SMALL),
    "five-views": Variant("many-views-kato", _SUPERVISION, batch_factor=GROUP_SIZE, **_SMALL),  # encodes one of five
    "plus-without-symmetry": Variant("plus-kato", {"symmetry": None}, **_SMALL),
    "plus-without-novel-views": Variant("plus-kato", {"lambda_novel_view": 0.0}, **_SMALL),
}


@dataclass(frozen=True)
class Table:
    """One table."""

    rows: Mapping[str, Row]  # by label
    baseline: str  # label of the row that is subtracted from the others
    title: str
    measure: Literal["voxel_iou", "mmd"] = "voxel_iou"
    layout: Layout = "kato"
    categories: tuple[str, ...] = CATEGORIES
    seeds: int = 1


_ROWS = read_rows()
_OURS: dict[str, Any] = {"categories": ("airplane", "chair", "table"), "seeds": 3}
_NO_TABLE = "voxel IoU on Kato's data (no table of the paper)"
_THREE = ("airplane", "car", "chair")

#: By name: the tables of the paper, and three of our own.
TABLES: dict[str, Table] = {
    "kato": Table(_ROWS["kato"], "Vanilla-AE", "Voxel IoU on Kato's data (Table 1)"),
    "prgan": Table(
        _ROWS["prgan"], "PrGAN", "Comparison with PrGAN, voxel IoU on Kato's data (Table 2)", categories=_THREE
    ),
    "kar": Table(_ROWS["kar"], "Vanilla-AE", "Voxel IoU on Kar's data, continuous viewpoints (Table 3)", layout="kar"),
    "ablation": Table(_ROWS["ablation"], "Proposed", "One loss term off at a time, voxel IoU on Kato's data (Table 4)"),
    "bins": Table(
        _ROWS["bins"], "15x20 degrees", "Number of view bins, voxel IoU on Kar's data (Table 5)", layout="kar"
    ),
    "mmd": Table(
        _ROWS["mmd"],
        "Vanilla-AE",
        "MMD between the shape codes of different views on Kato's data (Table 6); lower is better",
        "mmd",
    ),
    "pascal": Table(
        _ROWS["pascal"],
        "Baseline",
        "Voxel IoU on Pascal3D+, mean of five runs (Table 7)",
        layout="pascal3d",
        categories=_THREE,
        seeds=5,
    ),
    "plus": Table(_ROWS["plus"], "Proposed", f"What Plus adds to the proposed method, {_NO_TABLE}", **_OURS),
    "supervision": Table(
        _ROWS["supervision"], "Single views", f"One, two or five views behind each shape, {_NO_TABLE}", **_OURS
    ),
    "poses": Table(_ROWS["poses"], "Known poses", f"Plus on estimated azimuths, {_NO_TABLE}", **_OURS),
}
