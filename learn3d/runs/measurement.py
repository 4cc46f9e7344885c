"""Measures trained networks on a split, for `learn3d evaluate` and for experiments."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import BaseModel, Field

from learn3d.data.dataset import ViewDataset
from learn3d.data.layouts import Layout, require_folder
from learn3d.evaluation import (
    CODES_PER_VIEW,
    F_SCORE_DISTANCE,
    NO_MMD,
    SURFACE_POINTS,
    Evaluation,
    evaluate,
)
from learn3d.files import limits
from learn3d.files.reading import read_bytes
from learn3d.presets import command_line
from learn3d.runs import checkpoint
from learn3d.runs.folder import METRICS
from learn3d.runs.log import read_records
from learn3d.settings import LARGEST, Step, split_names
from learn3d.terminal import align, note

#: For each measure its header in tables and its definition. Measures are means over images, then over categories.
MEASURES = {
    "voxel_iou": (
        "voxel IoU",
        "IoU of predicted and true 32^3 grids, voxelizer of Kato et al. 2018 (kato18), as in the paper",
    ),
    "voxel_iou_kato19": (
        "IoU (kato19)",
        "voxelizer of Kato and Harada 2019; not comparable with the voxel IoU",
    ),
    "voxel_iou_unclamped": (
        "unclamped IoU",
        "voxel IoU (kato18) without the clamp to the cube, as the published code measures it",
    ),
    "precision": (
        "precision",
        "part of the predicted voxels that is true: low if shapes are too full",
    ),
    "recall": ("recall", "part of the true voxels that is predicted: low if parts are missing"),
    "chamfer_l1": (
        "Chamfer-L1",
        f"mean distance of {SURFACE_POINTS} points of either surface to the other, without empty predictions; "
        "without true points in the data the surfaces are those of the voxels",
    ),
    "f_score": (
        "F-score",
        f"harmonic mean of the shares of these points within {F_SCORE_DISTANCE} of the other surface",
    ),
    "silhouette_iou": ("silhouette IoU", "with the mask of another image of the object"),
    "mmd": (
        "MMD",
        f"between the shape codes of two views, up to {CODES_PER_VIEW} each, mean over all pairs of views, by the "
        "published code (five kernels, no root): the smaller, the less a code depends on the view",
    ),
    "mmd_paper": (
        "printed MMD",
        "the same by the formula that the paper prints: one kernel, square root",
    ),
    "mmd_floor": (
        "shuffled MMD",
        "MMD after the views of each object were shuffled: its value for codes without pose, from as many images",
    ),
}
HEADERS = [header for header, _ in MEASURES.values()]

Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)] | None
Amount = Annotated[int, Field(ge=0, le=10**9)]


class ObjectMeans(NamedTuple):
    """Mean IoUs of the images of one object."""

    name: str
    images: Amount  # number of images that have an IoU
    voxel_iou: Number
    voxel_iou_kato19: Number


class CurvePoint(NamedTuple):
    """One validation during a training."""

    split: str
    step: Amount
    voxel_iou: Number
    mmd: Number


class AngleMean(NamedTuple):
    """Mean IoU of the silhouettes of predicted shapes at an angle from the input's view."""

    degrees: Amount  # difference of the azimuths
    silhouette_iou: Number


class Result(BaseModel, strict=True):
    """Measures of one checkpoint on one category and split; None if a measure has no value."""

    checkpoint: str  # file
    method: str  # label of the preset
    preset: str
    category: str
    data: str
    command: str  # command that repeats the training
    iterations: Step  # length of the whole training
    step: Amount  # step after which these networks were saved
    seed: Amount
    seconds: Number  # duration of the training
    versions: dict[str, str | None]  # packages and commit of the training
    images: Amount
    hollow: Number  # share of meshes that reach beyond the voxel grid
    voxel_iou: Number
    voxel_iou_kato19: Number
    voxel_iou_unclamped: Number = None
    precision: Number
    recall: Number
    chamfer_l1: Number
    f_score: Number
    silhouette_iou: Number
    mmd: Number
    mmd_paper: Number
    mmd_floor: Number = None
    objects: list[ObjectMeans]  # [] for data without voxels
    # by the angle from the input's view; [] if azimuths are unknown or no object has two images
    angles: list[AngleMean] = []
    # Fields that an experiment adds:
    curve: list[CurvePoint] = []  # the validations of the training
    # the other checkpoint, last or best on the validation images; None if it is the same step
    other: "Result | None" = None

    @property
    def commit(self) -> str:
        """First nine digits of the commit that trained the run, with its mark for changed
        sources; "-" if unknown.
        """
        commit = self.versions.get("commit") or "-"
        return commit[:9] + "-dirty" * commit.endswith("-dirty")


class Baseline(BaseModel, strict=True):
    """Voxel IoU of one answer to all images of a split.

    Truth and answer are voxels of the data set, so the IoU does not depend on a voxelizer.
    """

    name: str  # one of `baselines.BASELINES`
    category: str
    data: str
    voxel_iou: Number
    voxel_iou_kato19: Number  # the same number
    objects: list[ObjectMeans]


def evaluate_runs(
    paths: Sequence[Path],
    *,
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    which: Literal["last", "best"] = "last",
    layout: Layout | None = None,
    device: str = "cpu",
) -> Iterator[Result]:
    """Measure run folders (their checkpoint `which`) or checkpoint files, on each of their
    categories by itself. Yields each result when it is known.

    `data` and `category` default to those of the training. A model that learnt from estimated
    poses is measured with them only on its own data (`data` is None). Raises ValueError or
    OSError before anything is measured if a checkpoint or a data folder is missing.
    """
    if not paths:
        raise ValueError("give at least one run folder or checkpoint to evaluate")
    files = dict.fromkeys(checkpoint.find(path, which) for path in paths)
    for file in files:
        require_folder(data or checkpoint.load_metadata(file).config.data)
    for file in files:
        method, config, metadata = checkpoint.load_method(file, device=device)
        label = config.label
        for name in split_names(category or config.category):
            note(f"{file}: {label} ({config.preset}) on {name}, {split}")
            dataset = checkpoint.load_data(config, split, data=data, category=name, layout=layout)
            evaluation = evaluate(method, dataset, detailed=True, title=name)
            means = dict.fromkeys((*MEASURES, "hollow")) | evaluation.means
            if means["hollow"]:
                note(
                    f"warning: {means['hollow']:.1%} of the meshes reach beyond the voxel grid and count as hollow"
                )
            if means["mmd"] is None:
                note(f"warning: {NO_MMD}")
            yield Result(
                checkpoint=str(file),
                method=label,
                preset=config.preset,
                category=name,
                data=str((data or config.data).resolve()),
                command=command_line(config),
                iterations=config.iterations,
                step=metadata.progress.step,
                seed=config.seed,
                seconds=metadata.progress.seconds,
                versions=metadata.versions,
                images=len(evaluation.view_ids),
                objects=[] if dataset.voxels is None else _means_by_object(evaluation, dataset),
                angles=[AngleMean(*pair) for pair in evaluation.angle_ious.items()],
                **means,
            )


def read_curve(folder: Path) -> list[CurvePoint]:
    """The validations of a run, from its metrics.jsonl."""
    content = read_bytes(folder / METRICS, limits.METRICS_BYTES, "the metrics of a run")
    records = [record for _, record in read_records(content) if record["split"] != "train"]
    return [CurvePoint(r["split"], r["step"], r.get("voxel_iou"), r.get("mmd")) for r in records]


def _means_by_object(evaluation: Evaluation, dataset: ViewDataset) -> list[ObjectMeans]:
    values = torch.stack(
        [evaluation.values[name] for name in ("voxel_iou", "voxel_iou_kato19")], dim=1
    )
    objects = []
    for number in evaluation.object_ids.unique():
        own = values[(evaluation.object_ids == number) & ~values[:, 0].isnan()].numpy()
        means = (round(float(mean), 5) for mean in own.mean(0)) if len(own) else (None, None)
        objects.append(ObjectMeans(dataset.object_names[number], len(own), *means))
    return objects


def format_table(results: Sequence[Result], baselines: Sequence[Baseline] = ()) -> str:
    """The results as a text table, then the mean over categories of each method, then baselines."""
    rows = [("class", "method", "seed", "iterations", "images", *HEADERS)]
    for r in results:
        about = (r.category, f"{r.method} ({r.preset})", str(r.seed), str(r.step), str(r.images))
        rows.append((*about, *format_measures(vars(r))))
    for m in class_means(results):
        classes = f"{m['classes']} classes" if m["classes"] > 1 else "1 class"
        rows.append(
            ("mean", f"{m['method']} ({m['preset']})", "", "", classes, *format_measures(m))
        )
    for b in baselines:
        images = str(sum(o.images for o in b.objects))
        values = dict.fromkeys(MEASURES) | {"voxel_iou": b.voxel_iou}
        rows.append((b.category, b.name, "", "", images, *format_measures(values)))
    return align(rows)


def format_measures(values: dict[str, Any]) -> list[str]:
    """All measures with four digits, as cells below `HEADERS`."""
    return ["-" if values[name] is None else f"{values[name]:.4f}" for name in MEASURES]


def class_means(results: Iterable[Result]) -> list[dict[str, Any]]:
    """Each method's measures, as means over seeds, then over categories.

    Methods with two runs of one category and seed are left out: other settings are no seeds.
    """
    by_method: dict[tuple[str, str], dict[str, list[Result]]] = {}
    for r in results:
        by_method.setdefault((r.method, r.preset), {}).setdefault(r.category, []).append(r)
    return [
        {"method": method, "preset": preset, "classes": len(classes)}
        | {
            name: _mean(_mean(getattr(r, name) for r in same) for same in classes.values())
            for name in MEASURES
        }
        for (method, preset), classes in by_method.items()
        if all(len({r.seed for r in same}) == len(same) for same in classes.values())
    ]


def _mean(values: Iterable[float | None]) -> float | None:
    values = list(values)
    return None if None in values else sum(values) / len(values)
