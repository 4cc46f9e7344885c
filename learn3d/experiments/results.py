"""The measurement of one finished run on its test split, kept in a file that reports need no network to read.

The file may be a stranger's: it is checked when it is read.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import BaseModel, Field, ValidationError

from learn3d.config import config_from_dict, config_to_dict, differences, load_config
from learn3d.evaluation import evaluate
from learn3d.experiments.plan import Run, command_line
from learn3d.files import limits, writing
from learn3d.files.reading import parse_json, read_bytes
from learn3d.runs import checkpoint
from learn3d.runs.folder import CONFIG, LAST
from learn3d.runs.versions import versions
from learn3d.settings import MOST, Step

RESULT_FILE = "test.json"  # in a run's folder
DEFINITIONS = ("kato18", "kato19")
SPLIT = "test"
DIGITS = 5  # of stored values


def measure(run: Run) -> dict[str, Any]:
    """Evaluate a trained run in fp32 on all images of the test split and write <run>/test.json; returns what it holds.

    Keys: the configuration and the command that repeats it; iterations, step of the networks tested, seconds of
    training, versions at training and at testing; voxel IoU by both voxelisers, Chamfer-L1, F-score, both MMDs; and
    "objects" and "views": for each of them the number of its images, the number with a defined IoU and the mean IoU.

    Raises ValueError where there is no checkpoint, or no voxels to compare with.
    """
    config = run.config
    last = checkpoint.load_metadata(run.folder / LAST)
    method, saved, metadata = checkpoint.load_method(
        run.folder / f"{run.variant.checkpoint}.safetensors", device=config.device, precision="fp32"
    )
    dataset = checkpoint.load_data(config, SPLIT)
    if dataset.voxels is None:
        raise ValueError(f"{config.data} has no voxels for {run.category}, {SPLIT}: IoU cannot be measured")
    result = evaluate(method, dataset, definitions=DEFINITIONS, paper_mmd=True, surfaces=True)
    record = {
        "config": config_to_dict(saved),
        "command": command_line(config),
        "data": str(config.data.resolve()),
        "checkpoint": run.variant.checkpoint,
        "iterations": last.progress.step,
        "step": metadata.progress.step,
        "seed": config.seed,
        "seconds": last.progress.seconds,
        "fingerprint": dataclasses.asdict(last.fingerprint),
        "trained_by": last.versions,
        "tested_by": versions(),
    }
    summary = {key: value for key, value in result.summary().items() if key != "voxel_iou"}
    tables = {
        "objects": _means_by(result.object_ids, result.ious, dataset.object_names),
        "views": _means_by(result.view_ids, result.ious, dataset.view_names),
    }
    record |= summary | tables
    writing.write_json(run.folder / RESULT_FILE, record)
    return record


Number = Annotated[float, Field(ge=-MOST, le=MOST)] | None
Amount = Annotated[int, Field(ge=0, le=10**9)]


class _Objects(BaseModel, strict=True):
    names: list[str]
    defined: list[Amount]
    kato18: list[Number]
    kato19: list[Number]


class _Versions(BaseModel, strict=True):
    commit: str | None = None


class _Result(BaseModel, strict=True):
    """What a report needs of a result."""

    config: dict[str, Any]
    command: str
    data: str
    checkpoint: str
    iterations: Step
    images: Amount
    objects: _Objects
    step: Amount = 0
    seconds: Number = None
    voxel_iou_kato18: Number = None
    voxel_iou_kato19: Number = None
    mmd: Number = None
    mmd_paper: Number = None
    chamfer_l1: Number = None
    f_score: Number = None
    fingerprint: dict[str, Any] | None = None
    trained_by: _Versions | None = None
    tested_by: _Versions | None = None


def read_result(path: Path) -> dict[str, Any]:
    """What `measure` wrote. A file that is damaged, or holds something else, is a ValueError that names it."""
    content = read_bytes(path, limits.JSON_BYTES, "the measurement of a run as JSON")
    try:
        result = parse_json(content)
        objects = _Result.model_validate(result).objects
        if len({len(objects.names), len(objects.defined), len(objects.kato18), len(objects.kato19)}) > 1:
            raise ValueError("the lists of its objects differ in length")
    except ValidationError as error:
        first = error.errors()[0]
        what = f"{'.'.join(map(str, first['loc'])) or 'it'}: {first['msg']}"
        raise ValueError(f"{path} is no measurement of a run ({what}); remove it, and it is made again") from None
    except ValueError as error:
        raise ValueError(f"{path} cannot be used: {error}; remove it, and it is made again") from None
    return result


def read_results(runs: Sequence[Run]) -> dict[Path, dict[str, Any]]:
    """The stored results of those runs that have one of these networks on this data, by folder."""
    found = [(run, read_result(path)) for run in runs if (path := run.folder / RESULT_FILE).is_file()]
    return {run.folder: result for run, result in found if _is_current(run, result)}


def _is_current(run: Run, result: dict[str, Any]) -> bool:
    wanted = (run.config.iterations, run.variant.checkpoint, str(run.config.data.resolve()))
    return (result["iterations"], result["checkpoint"], result["data"]) == wanted


def conflicts_with(run: Run) -> str:
    """In what the run in the folder differs from the one that is planned, as a sentence; "" where it can go on."""
    if (run.folder / CONFIG).is_file():
        saved = load_config(run.folder / CONFIG)
    elif (path := run.folder / RESULT_FILE).is_file():
        saved = config_from_dict(read_result(path)["config"], str(path))
    else:
        return ""
    changed = differences(run.config, saved)
    if run.variant.checkpoint == "best" and run.config.val_split != saved.val_split:
        changed.append(
            f"val_split: {saved.val_split!r} chose the run's best networks, {run.config.val_split!r} asked for"
        )
    return f"{run.folder} has a run with other options: " + "; ".join(changed) if changed else ""


def object_sums(record: dict[str, Any], definition: str) -> tuple[np.ndarray, np.ndarray]:
    """(sum of the IoUs, number of IoUs), both float64 [N], of the objects of a stored result."""
    defined = np.array(record["objects"]["defined"], np.float64)
    means = np.array([0.0 if mean is None else mean for mean in record["objects"][definition]])
    return means * defined, defined


def _means_by(ids: torch.Tensor, ious: dict[str, torch.Tensor], names: tuple[str, ...]) -> dict[str, Any]:
    """Names, numbers of images and mean IoUs (None where undefined) of the groups that occur in `ids`, int64 [M]."""
    ids = ids.numpy()
    values = {name: value.numpy() for name, value in ious.items()}
    known = ~np.isnan(next(iter(values.values())))
    groups = np.unique(ids)
    images = np.bincount(ids, minlength=len(names))[groups]
    defined = np.bincount(ids[known], minlength=len(names))[groups]
    table: dict[str, Any] = {
        "names": [names[g] for g in groups],
        "images": images.tolist(),
        "defined": defined.tolist(),
    }
    for name, value in values.items():
        sums = np.bincount(ids[known], weights=value[known], minlength=len(names))[groups]
        table[name] = [round(s / n, DIGITS) if n else None for s, n in zip(sums, defined, strict=True)]
    return table
