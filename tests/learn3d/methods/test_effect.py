"""Pose confusion: the encoder learns codes from which a trained discriminator can no longer tell the view.

The effects on the IoU and on the MMD of codes take thousands of steps; docs/results.md has them.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from steps import TINY, make_method

from learn3d.data.dataset import Batch
from learn3d.data.readers import kato
from learn3d.losses import domain_confusion_loss, pose_classification_loss
from learn3d.methods.pose_invariant import PoseInvariant
from learn3d.studio.make_data.render import DatasetConfig, make_dataset
from learn3d.training import take_step

SIDES = (0, 6, 12, 18)  # views from the four sides


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> kato.ViewDataset:
    """Eight airplanes, seen from four sides."""
    folder = tmp_path_factory.mktemp("airplanes")
    make_dataset(DatasetConfig(output=folder, category="airplane", procedural=9, test=1, val=0))
    whole = kato.load(folder, "airplane", "train")
    part = whole.select(np.flatnonzero(np.isin(whole.view_ids, SIDES)))
    names = tuple(whole.view_names[view] for view in SIDES)
    return dataclasses.replace(
        part, view_ids=np.searchsorted(SIDES, part.view_ids), view_names=names
    )


def confusion(method: PoseInvariant, batch: Batch) -> float:
    """How sure the discriminator is of the views of the codes; 0 if it gives every view the same probability."""
    method.networks.eval()
    with torch.no_grad():
        loss = domain_confusion_loss(method.discriminator(method.encode(batch.images)), "log")
    method.networks.train()
    return float(loss)


@pytest.mark.parametrize(("weight", "unsure"), [(1.0, True), (0.0, False)])
def test_pose_confusion_takes_the_view_out_of_the_codes(
    dataset: kato.ViewDataset, weight: float, unsure: bool
) -> None:
    weights = {"lambda_adversarial": weight, "lambda_prior": 0.0, "learning_rate": 1e-3}
    method = make_method("peng2020-kato", dataset.info(None), **TINY, **weights)
    batch = dataset.batch(torch.arange(len(dataset)), voxels=False)
    learner = torch.optim.Adam(method.discriminator.parameters(), lr=3e-3)
    codes = method.encode(batch.images).detach()
    for _ in range(200):
        learner.zero_grad()
        loss = pose_classification_loss(method.discriminator(codes), batch.view_ids)
        loss.backward()
        learner.step()
    assert loss.item() < 0.4 * np.log(len(SIDES))  # it has learnt to tell them apart
    sure = confusion(method, batch)
    for _ in range(30):
        # even steps train the encoder against the discriminator, which stays as it is
        take_step(method, batch, 2)
    assert (confusion(method, batch) < 0.1 * sure) == unsure
