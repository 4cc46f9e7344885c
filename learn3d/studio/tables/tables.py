"""The tables of the paper, and three of our own: tables.csv, rows.csv with printed figures.

A new table is a line of tables.csv, and a line of rows.csv for each row. Rows of several tables
that name the same variant share their runs. Categories have the names of this package: the
paper's "Dresser" is ShapeNet's cabinet.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from learn3d.data.conventions import SYNSETS
from learn3d.data.layouts import Layout
from learn3d.data.sampling import GROUP_SIZE
from learn3d.methods.plus import PlusSettings

MEAN = "mean"  # the column after the categories
BATCH_DIVISOR = 4  # a step of Plus sees a quarter of the other methods' images, and Plus takes four times the steps


@dataclass(frozen=True)
class Variant:
    """A preset with changes.

    Its name is that of its run folders, so equal names mean the same runs in every table.
    """

    preset: str
    # settings of the method and options of the training
    changes: Mapping[str, Any] = field(default_factory=dict)
    # networks to test: the last ones, or the best on the validation split
    checkpoint: Literal["last", "best"] = "last"
    # preset that sees as many images, in BATCH_DIVISOR times larger batches; "" for none
    small_batches_of: str = ""
    # multiplies the batch size, if a batch also has images that are not encoded
    batch_factor: int = 1
    # azimuths are estimated with the run's seed, and turned into the data's frame
    estimates_poses: bool = False


class Row(NamedTuple):
    """One method in a table."""

    variant: str | None  # name in `VARIANTS`; None: a quoted row, never trained here
    about: str  # the voxelizer of the printed figures, and their source if they are quoted
    # the paper's figures by category, and their "mean"; without those that it lacks
    printed: dict[str, float]


_PLUS = PlusSettings()
_PROPOSED, _VANILLA = "peng2020-kato", "peng2020-kato-vanilla"
_SCHEDULE = {
    "lr_schedule": "cosine",
    "warmup_steps": 100,
    "ema_decay": 0.99,
    "learning_rate": _PLUS.learning_rate,
}
_SYMMETRY = {"symmetry": "auto"}
_SHARED_NAMES = (
    "encoder",
    "generator",
    "lambda_area",
    "clamp_to_cube",
    "lambda_smooth",
    "lambda_smooth_end",
)
_SHARED = _SCHEDULE | _SYMMETRY | {name: getattr(_PLUS, name) for name in _SHARED_NAMES}
#: Networks, smoothness and schedule of the table of supervision, whose methods encode as many
#: images as Plus.
_SUPERVISION = (
    _SCHEDULE | _SYMMETRY | {"encoder": "conv-light", "generator": "sphere", "clamp_to_cube": True}
)
_SUPERVISION |= {"lambda_smooth": 3e-4, "augment": ("colors",)}
_SMALL: dict[str, Any] = {"small_batches_of": _PROPOSED}
#: Widths of the view bins in azimuth and elevation, in degrees.
BIN_WIDTHS = ("60x60", "30x30", "20x20", "20x15", "15x20", "15x15", "10x10")

#: By name. Without the confusion loss the discriminator has no effect on the encoder, so its own
#: loss is off, too.
VARIANTS: dict[str, Variant] = {
    "proposed": Variant(_PROPOSED),
    "vanilla": Variant(_VANILLA),
    "vpl": Variant("peng2020-kato-vpl"),
    "prgan": Variant("gadelha2017-kato"),
    "plus": Variant("plus-kato", **_SMALL),
    "plus-estimated-poses": Variant("plus-kato", estimates_poses=True, **_SMALL),
    "without-prior": Variant(_PROPOSED, {"lambda_prior": 0.0}),
    "without-adversarial": Variant(
        _PROPOSED, {"lambda_adversarial": 0.0, "lambda_classification": 0.0}
    ),
    "without-smoothness": Variant(_PROPOSED, {"lambda_smooth": 0.0}),
    **{
        f"bins-{widths}": Variant("peng2020-kar", {"view_bins": widths}, "best")
        for widths in BIN_WIDTHS
    },
    "kar-vanilla": Variant("peng2020-kar-vanilla", checkpoint="best"),
    "kar-plus": Variant("plus-kar", checkpoint="best", small_batches_of="peng2020-kar"),
    "pascal-proposed": Variant("peng2020-pascal", checkpoint="best"),
    "pascal-baseline": Variant("peng2020-pascal-vanilla", checkpoint="best"),
    "pascal-plus": Variant("plus-pascal", checkpoint="best", small_batches_of="peng2020-pascal"),
    "vanilla-schedule-symmetry": Variant(_VANILLA, _SCHEDULE | _SYMMETRY),
    "proposed-schedule": Variant(_PROPOSED, _SCHEDULE),
    "proposed-schedule-symmetry": Variant(_PROPOSED, _SCHEDULE | _SYMMETRY),
    "proposed-shared": Variant(_PROPOSED, _SHARED, **_SMALL),
    "vanilla-shared": Variant(_VANILLA, _SHARED, **_SMALL),
    "single-views": Variant(_VANILLA, _SUPERVISION, **_SMALL),
    "pairs": Variant("multi-view-kato", _SUPERVISION, **_SMALL),
    "five-views": Variant(
        "many-views-kato", _SUPERVISION, batch_factor=GROUP_SIZE, **_SMALL
    ),  # encodes one of five
    "plus-without-symmetry": Variant("plus-kato", {"symmetry": None}, **_SMALL),
    "plus-without-novel-views": Variant("plus-kato", {"lambda_novel_view": 0.0}, **_SMALL),
}


class Table(NamedTuple):
    """One table."""

    title: str
    baseline: str  # label of the row that is subtracted from the others
    measure: Literal["voxel_iou", "mmd"]
    layout: Layout
    categories: tuple[str, ...]
    seeds: int
    rows: Mapping[str, Row]  # by label


def read_tables() -> dict[str, Table]:
    """The tables by name, from tables.csv and rows.csv beside this module."""
    rows: dict[str, dict[str, Row]] = {}
    for line in _read_csv("rows.csv"):
        printed = {name: float(line[name]) for name in (*SYNSETS, MEAN) if line[name]}
        row = Row(line["variant"] or None, line["source"], printed)
        rows.setdefault(line["experiment"], {})[line["method"]] = row
    tables = {}
    for line in _read_csv("tables.csv"):
        name = line.pop("experiment")
        categories = tuple(line["categories"].split()) or tuple(SYNSETS)
        tables[name] = Table(
            **line | {"categories": categories, "seeds": int(line["seeds"]), "rows": rows[name]}
        )
    return tables


def _read_csv(name: str) -> list[dict[str, str]]:
    with open(Path(__file__).with_name(name), encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


#: By name.
TABLES = read_tables()
