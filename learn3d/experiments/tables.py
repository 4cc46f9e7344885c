"""The tables of the paper (Peng et al. 2020) as data: rows, which are a preset with changes, and the printed figures.

A new table is a new entry of `TABLES`. Rows of several tables that name the same variant share their runs. Categories
have the names of this package: the paper's "Dresser" is ShapeNet's cabinet.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from learn3d.data.layouts import Layout
from learn3d.data.sampling import GROUP_SIZE
from learn3d.methods.plus import PlusSettings
from learn3d.presets import full_name

#: The 13 categories, in the order of the paper's columns.
CATEGORIES = tuple(
    "airplane bench cabinet car chair display lamp loudspeaker rifle sofa table telephone vessel".split()
)
MEAN = "mean"  # the column after the categories
_THREE = ("airplane", "car", "chair")


@dataclass(frozen=True)
class Variant:
    """A preset with changes. Its name is that of its run folders, so equal names mean the same runs in every table."""

    preset: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # settings of the method and options of the training
    checkpoint: Literal["last", "best"] = "last"  # networks to test: the last ones, or the best on the validation split
    batch_divisor: int = 1  # divides the batch size and multiplies the iterations, so that as many images are seen
    batch_factor: int = 1  # multiplies the batch size, if a batch also has images that are not encoded
    estimates_poses: bool = False  # azimuths are estimated with the run's seed, and turned into the data's frame
    length_of: str = ""  # preset whose batch size and iterations count; "" means its own


@dataclass(frozen=True)
class Row:
    """One method in a table."""

    variant: str | None  # name in `VARIANTS`; None: a quoted row, never trained here
    figures: str = ""  # printed values: 13 or 3 categories and their mean, or the mean alone; "" if the row is ours
    about: str = "kato18"  # the voxelizer of the printed figures, and their source if the paper quotes them

    @property
    def printed(self) -> dict[str, float]:
        """The paper's figures by category, and their "mean"; without those that it lacks."""
        figures = self.figures.split()
        names = {14: (*CATEGORIES, MEAN), 4: (*_THREE, MEAN), 1: (MEAN,), 0: ()}[len(figures)]
        return {name: float(figure) for name, figure in zip(names, figures, strict=True) if figure != "-"}


@dataclass(frozen=True)
class Table:
    """One table."""

    title: str
    baseline: str  # label of the row that is subtracted from the others
    rows: Mapping[str, Row]  # by label
    measure: Literal["voxel_iou", "mmd"] = "voxel_iou"
    layout: Layout = "kato"
    categories: tuple[str, ...] = CATEGORIES
    seeds: int = 1


_PLUS = PlusSettings()
_BATCH_DIVISOR = 4  # a step of Plus sees a quarter of the other methods' images, and Plus takes four times the steps
_SCHEDULE = {"lr_schedule": "cosine", "warmup_steps": 100, "ema_decay": 0.99, "learning_rate": _PLUS.learning_rate}
_SYMMETRY = {"symmetry": "auto"}
_SHARED_NAMES = ("encoder", "generator", "lambda_area", "clamp_to_cube", "lambda_smooth", "lambda_smooth_end")
_SHARED = _SCHEDULE | _SYMMETRY | {name: getattr(_PLUS, name) for name in _SHARED_NAMES}
_SUPERVISION = _SYMMETRY | {"encoder": "conv-light", "generator": "sphere", "clamp_to_cube": True}
_SUPERVISION |= {"lambda_smooth": 3e-4, "augment": ("colors",)}
#: Table 5: mean voxel IoU over the categories of Kar's data, by widths of the view bins in azimuth and elevation.
BINS = {"60x60": 0.497, "30x30": 0.499, "20x20": 0.501, "20x15": 0.500, "15x20": 0.504, "15x15": 0.498, "10x10": 0.490}


def _plus(data: str, changes: Mapping[str, Any] | None = None, **options: Any) -> Variant:
    """Plus on as many images as the paper's preset for these data sees."""
    options |= {"batch_divisor": _BATCH_DIVISOR, "length_of": f"peng2020-{data}"}
    return Variant(f"plus-{data}", changes or {}, **options)


def _kato(changes: Mapping[str, Any], method: str = "proposed", **options: Any) -> Variant:
    return Variant(full_name(method), changes, **options)


def _supervision(method: str, **options: Any) -> Variant:
    """A method with the networks, smoothness and schedule of the table of supervision; it encodes as many images as
    Plus.
    """
    options |= {"batch_divisor": _BATCH_DIVISOR, "length_of": full_name("proposed")}
    return _kato(_SCHEDULE | _SUPERVISION, method, **options)


#: By name. Without the confusion loss the discriminator has no effect on the encoder, so its own loss is off, too.
VARIANTS: dict[str, Variant] = {
    **{method: _kato({}, method) for method in ("proposed", "vanilla", "vpl", "prgan")},
    "plus": _plus("kato"),
    "plus-estimated-poses": _plus("kato", estimates_poses=True),
    "without-prior": _kato({"lambda_prior": 0.0}),
    "without-adversarial": _kato({"lambda_adversarial": 0.0, "lambda_classification": 0.0}),
    "without-smoothness": _kato({"lambda_smooth": 0.0}),
    **{f"bins-{w}": Variant("peng2020-kar", {"view_bins": w}, "best") for w in BINS},
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
    "single-views": _supervision("vanilla"),
    "pairs": _supervision("multi-view"),
    "five-views": _supervision("many-views", batch_factor=GROUP_SIZE),  # one of each group is encoded
    "plus-without-symmetry": _plus("kato", {"symmetry": None}),
    "plus-without-novel-views": _plus("kato", {"lambda_novel_view": 0.0}),
}


_PROPOSED = ".565 .410 .661 .670 .415 .532 .378 .434 .533 .592 .417 .684 .528  .524"
_VPL_PAPER = "kato19, quoted from Kato and Harada 2019"
_COMMENTED = "kato18; figures by category from comments in the paper's source"

#: By name: the tables of the paper, and three of our own.
TABLES: dict[str, Table] = {
    "kato": Table(
        "Voxel IoU on Kato's data (Table 1)",
        "Vanilla-AE",
        {
            "Vanilla-AE": Row("vanilla", ".318 .304 .377 .534 .233 .267 .378 .287 .333 .390 .375 .376 .475  .357"),
            "VPL": Row("vpl", ".533 .367 .666 .635 .386 .500 .330 .576 .356 .558 .416 .670 .453  .496"),
            "Proposed": Row("proposed", _PROPOSED),
        },
    ),
    "prgan": Table(
        "Comparison with PrGAN, voxel IoU on Kato's data (Table 2)",
        "PrGAN",
        {
            "PrGAN": Row("prgan", ".151 .228 .114  .164"),
            "Proposed": Row("proposed", ".565 .670 .415  .550"),
        },
        categories=_THREE,
    ),
    "kar": Table(
        "Voxel IoU on Kar's data, continuous viewpoints (Table 3)",
        "Vanilla-AE",
        {
            "Vanilla-AE": Row(
                "kar-vanilla", ".479 .266 .466 .550 .367 .265 .454 .524 .382 .367 .342 .337 .439  .403", _VPL_PAPER
            ),
            "VPL": Row("kar-vpl", ".513 .376 .591 .701 .444 .425 .422 .596 .479 .500 .436 .595 .485  .505", _VPL_PAPER),
            "Proposed": Row("bins-15x20", ".528 .360 .569 .742 .433 .423 .378 .528 .542 .537 .384 .624 .505  .504"),
            "Plus": Row("kar-plus"),
        },
        layout="kar",
    ),
    "ablation": Table(
        "One loss term off at a time, voxel IoU on Kato's data (Table 4)",
        "Proposed",
        {
            "Proposed": Row("proposed", _PROPOSED),
            "w/o prior": Row(
                "without-prior", ".552 .350 .581 .680 .313 .508 .385 .500 .519 .583 .413 .687 .515  .507", _COMMENTED
            ),
            "w/o adversarial": Row(
                "without-adversarial",
                ".403 .371 .553 .572 .329 .369 .376 .335 .352 .500 .385 .435 .475  .420",
                _COMMENTED,
            ),
            "w/o smoothness": Row(
                "without-smoothness",
                ".559 .386 .666 .654 .401 .543 .410 .618 .588 .628 .385 .723 .476  .541",
                _COMMENTED,
            ),
        },
    ),
    "bins": Table(
        "Number of view bins, voxel IoU on Kar's data (Table 5)",
        "15x20 degrees",
        {f"{widths} degrees": Row(f"bins-{widths}", str(mean)) for widths, mean in BINS.items()},
        layout="kar",
    ),
    "mmd": Table(
        "MMD between the shape codes of different views on Kato's data (Table 6); lower is better",
        "Vanilla-AE",
        {
            "Vanilla-AE": Row(
                "vanilla", "1.825 2.389 .737 4.040 1.240 1.488 .018 .647 2.385 2.309 .521 2.306 1.848  1.673", "mmd"
            ),
            "Proposed": Row(
                "proposed", ".272 .382 .051 .990 .106 .152 .014 .079 .249 .173 .033 .298 .639  .264", "mmd"
            ),
        },
        measure="mmd",
    ),
    "pascal": Table(
        "Voxel IoU on Pascal3D+, mean of five runs (Table 7)",
        "Baseline",
        {
            "CSDM": Row(None, ".398 .600 .291  .429", "voxelizer not stated, quoted from Kar et al. 2015"),
            "CMR": Row(None, ".46 .64 - -", "voxelizer not stated, quoted from Kanazawa et al. 2018"),
            "VPL": Row("pascal-vpl", ".472 .689 .303  .488", f"{_VPL_PAPER}, without texture"),
            "Baseline": Row("pascal-baseline", ".423 .672 .265  .453"),
            "Proposed": Row("pascal-proposed", ".458 .695 .277  .477"),
            "Plus": Row("pascal-plus"),
        },
        layout="pascal3d",
        categories=_THREE,
        seeds=5,
    ),
    "plus": Table(
        "What Plus adds to the proposed method, voxel IoU on Kato's data (no table of the paper)",
        "Proposed",
        {
            "Vanilla-AE": Row("vanilla"),
            "Vanilla-AE, schedule and symmetry": Row("vanilla-schedule-symmetry"),
            "Proposed": Row("proposed"),
            "Proposed, schedule": Row("proposed-schedule"),
            "Proposed, schedule and symmetry": Row("proposed-schedule-symmetry"),
            "Vanilla-AE, all that is shared": Row("vanilla-shared"),
            "Proposed, all that is shared": Row("proposed-shared"),
            "Plus, w/o novel views": Row("plus-without-novel-views"),
            "Plus, w/o symmetry": Row("plus-without-symmetry"),
            "Plus": Row("plus"),
        },
        categories=("airplane", "chair", "table"),
        seeds=3,
    ),
    "supervision": Table(
        "One, two or five views behind each shape, voxel IoU on Kato's data (no table of the paper)",
        "Single views",
        {
            "Single views": Row("single-views"),
            "Pairs of views": Row("pairs"),
            "Five views": Row("five-views"),
        },
        categories=("airplane", "chair", "table"),
        seeds=3,
    ),
    "poses": Table(
        "Plus on estimated azimuths, voxel IoU on Kato's data (no table of the paper)",
        "Known poses",
        {"Known poses": Row("plus"), "Estimated poses": Row("plus-estimated-poses")},
        categories=("airplane", "chair", "table"),
        seeds=3,
    ),
}
