"""The paper's claims in small: the method raises the IoU, and pose confusion takes the view out of the codes.

`test_the_method_raises_the_iou` is the comparison of the README's quick start, a little shorter: 250 procedural
airplanes from 24 views, the paper's networks, 600 steps of 128, by `learn3d experiment`.
Some four minutes on two cores.

The other is smaller: 16 airplanes from four sides, every image on its own, small networks, 1,200 steps: some 40 s for
each of two trainings. Measured: MMD of confusion alone, without the prior, 0.73, 0.40, 0.02 of Vanilla-AE's with seeds
0, 1, 2. A confusion loss whose gradient does not reach the encoder gives 1: nothing differs from Vanilla-AE then. On so
little the IoU and the MMD of the whole method (0.63, 0.45, 0.66, but 1.03 with the kernels after it) are too noisy.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from learn3d.data.dataset import ViewDataset
from learn3d.data.readers import kato
from learn3d.data.sampling import sample_indices
from learn3d.evaluation import Evaluation, evaluate
from learn3d.make_data.render import DatasetConfig, make_dataset
from learn3d.methods import DatasetInfo, create_method
from learn3d.presets import PRESETS

VIEWS = (0, 6, 12, 18)  # from the four sides
STEPS = 1200
SEED = 1


def seen_from_four_sides(dataset: ViewDataset, objects: int) -> ViewDataset:
    keep = np.flatnonzero(np.isin(dataset.view_ids, VIEWS) & (dataset.object_ids < objects))
    part = dataset.select(keep)
    names = tuple(dataset.view_names[view] for view in VIEWS)
    return dataclasses.replace(part, view_ids=np.searchsorted(VIEWS, part.view_ids), view_names=names)


@pytest.fixture(scope="module")
def splits(tmp_path_factory: pytest.TempPathFactory) -> tuple[ViewDataset, ViewDataset]:
    folder = tmp_path_factory.mktemp("airplanes")
    config = DatasetConfig(output=folder, category="airplane", procedural=120, test=20, val=4)
    make_dataset(config, progress=False)
    return tuple(
        seen_from_four_sides(kato.load(folder, "airplane", split), objects)
        for split, objects in (("train", 16), ("test", 20))
    )


def train_small(preset: str, train_set: ViewDataset, test_set: ViewDataset, **changes: float) -> Evaluation:
    small = {"encoder": "conv-small", "generator": "sphere-small", "learning_rate": 1e-3}
    settings = dataclasses.replace(PRESETS[preset].settings, **small, **changes)
    method = create_method(settings, DatasetInfo(len(VIEWS)), device="cpu", precision="fp32", seed=SEED)
    for step in range(1, STEPS + 1):
        method.take_step(train_set.batch(sample_indices(train_set, "views", 32, SEED, step)), step)
    return evaluate(method, test_set)


@pytest.fixture(scope="module")
def vanilla(splits) -> Evaluation:
    return train_small("peng2020-kato-vanilla", *splits)


@pytest.mark.slow
def test_the_method_raises_the_iou(tmp_path: Path) -> None:
    """Measured, one thread: +.046, +.042 (seeds 0, 1, at d805aa2), +.019 (seed 0, with the kernels after it).

    Much of it is the prior's: with a prior that does nothing .020 is left of .046, with a confusion of the wrong sign
    .047, so that a broken confusion shows in the MMD below and not here.
    """
    data, output = tmp_path / "data", tmp_path / "output"
    make_dataset(
        DatasetConfig(output=data, category="airplane", procedural=250, test=0.2, val=0.1, seed=0), progress=False
    )
    words = ["kato", "--data", data, "--output", output, "--category", "airplane", "--methods", "vanilla", "proposed"]
    words += ["--iterations", 600, "--jobs", 2, "--threads", 1, "--set", "validate_every=600"]
    command = [sys.executable, "-m", "learn3d", "experiment", *words]
    subprocess.run([str(word) for word in command], check=True)
    report = json.loads((output / "kato.json").read_text())
    vanilla, proposed = (row["cells"]["airplane"] for row in report["rows"])
    assert proposed["values"]["kato18"] > vanilla["values"]["kato18"] + 0.01


@pytest.mark.slow
def test_pose_confusion_alone_lowers_the_mmd(splits, vanilla) -> None:
    confused = train_small("peng2020-kato", *splits, lambda_prior=0.0)
    assert confused.mmd < 0.9 * vanilla.mmd
