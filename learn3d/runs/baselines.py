"""Voxel IoU of shapes that need no network: what the objects of a data set have in common."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from learn3d.data.layouts import Layout, load_dataset
from learn3d.runs import checkpoint
from learn3d.runs.measurement import Baseline, ObjectMeans
from learn3d.settings import split_names

#: Names of the baselines, in the order of `object_ious`.
MEAN_SHAPE, NEAREST, RANDOM = BASELINES = (
    "Mean shape",
    "Nearest training object",
    "Random training object",
)
_SHARES = np.arange(50) / 50  # thresholds of the mean grid
_BLOCK = 512  # training objects that are compared at a time


def baselines_of_runs(
    paths: Sequence[Path],
    *,
    data: Path | None = None,
    category: str | None = None,
    split: str = "test",
    which: Literal["last", "best"] = "last",
    layout: Layout | None = None,
) -> list[Baseline]:
    """The baselines of every data set and category that `evaluate_runs` measures, once each."""
    keys = {}
    for path in paths:
        config = checkpoint.load_metadata(path, which).config
        for name in split_names(category or config.category):
            keys[layout or config.layout, data or config.data, name] = None
    return [baseline for key in keys for baseline in measure_baselines(*key, split)]


def measure_baselines(
    layout: Layout, data: Path, category: str, split: str = "test"
) -> list[Baseline]:
    """The baselines of a category, from the voxels of its training split.

    Means are over images, as for methods. Raises ValueError or OSError if the data cannot be read.
    """
    train, measured = (load_dataset(layout, data, category, part) for part in ("train", split))
    if train.voxels is None or measured.voxels is None:
        raise ValueError(f"{category} in {data} has no true voxels to compare")
    images = np.bincount(measured.object_ids, minlength=measured.num_objects)
    shown = images > 0
    baselines = []
    ious = object_ious(train.voxels, measured.voxels)
    for name, values in zip(BASELINES, ious, strict=True):
        known = shown & ~np.isnan(values)
        mean = float(np.average(values[known], weights=images[known])) if known.any() else None
        objects = [
            ObjectMeans(object_name, int(count), *[round(float(iou), 5)] * 2)
            if is_known
            else ObjectMeans(object_name, 0, None, None)
            for object_name, count, iou, is_known in zip(
                measured.object_names, images, values, known, strict=True
            )
            if count
        ]
        baselines.append(
            Baseline(
                name=name,
                category=category,
                data=str(data.resolve()),
                voxel_iou=mean,
                voxel_iou_kato19=mean,
                objects=objects,
            )
        )
    return baselines


def object_ious(train: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, ...]:
    """IoUs of three answers with objects, voxels bool [N, s, s, s]: each float64 [N].

    The mean shape: cells that more than a share of the training objects fill; the share, in steps
    of 0.02, is the best for the training objects. The nearest training object: the one with the
    highest IoU, which an oracle would choose. A random one: the mean over all of them. NaN if
    the answer and the object are empty. train: voxels bool [M, s, s, s], M > 0, perhaps on disk.
    """
    truth = measured[np.arange(len(measured))].reshape(len(measured), -1)
    blocks = np.split(np.arange(len(train)), range(_BLOCK, len(train), _BLOCK))
    mean = sum(train[block].sum(0) for block in blocks).reshape(-1) / len(train)
    candidates = mean > _SHARES[:, None]
    scores = np.zeros(len(_SHARES))
    best, total = np.full(len(truth), np.nan), np.zeros(len(truth))
    for block in blocks:
        objects = train[block].reshape(len(block), -1)
        scores += np.nansum(pair_ious(candidates, objects), axis=1)
        pairs = pair_ious(truth, objects)
        best = np.fmax(best, np.fmax.reduce(pairs, axis=1))
        total += pairs.sum(1)
    shape = candidates[scores.argmax()]
    return pair_ious(truth, shape[None])[:, 0], best, total / len(train)


def pair_ious(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """IoU of each of `a` with each of `b`, bool [N, cells] and [M, cells]: float64 [N, M]; NaN if
    both are empty.
    """
    both = (a.astype(np.float32) @ b.astype(np.float32).T).astype(np.float64)  # exact below 2^24
    either = a.sum(1)[:, None] + b.sum(1) - both
    with np.errstate(invalid="ignore"):
        return both / either
