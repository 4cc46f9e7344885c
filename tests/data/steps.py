"""Methods that learn without a run: made of a preset, and the gradients of their losses."""

from __future__ import annotations

import dataclasses

import torch
from torch import nn

from learn3d.data.dataset import Batch, DatasetInfo
from learn3d.methods import create_method
from learn3d.methods.method import Losses, Method, MethodSettings
from learn3d.methods.optimization import TrainingSchedule
from learn3d.presets import PRESETS

INFO = DatasetInfo(24, inverted=False)
TINY = {"encoder": "conv-small", "generator": "sphere-small"}
TINY_VPL = {"generator": "sphere-small", "discriminator_channels": 2}
TINY_PRGAN = {
    "encoder_from_step": 3,
    "generator_channels": (2, 2, 2, 1),
    "discriminator_channels": (2, 2, 2, 2),
}


def make_method(
    settings: str | MethodSettings,
    info: DatasetInfo = INFO,
    schedule: TrainingSchedule = TrainingSchedule(),  # noqa: B008 (it is frozen)
    seed: int = 0,
    **changes: object,
) -> Method:
    """The method of these settings, or of those of a preset, with changes; on the CPU in float32."""
    if isinstance(settings, str):
        settings = PRESETS[settings].settings
    settings = dataclasses.replace(settings, **changes)
    options = {"device": "cpu", "precision": "fp32", "seed": seed, "schedule": schedule}
    return create_method(settings, info, **options)


def changed(networks: nn.ModuleDict, before: nn.ModuleDict) -> set[str]:
    """The names of the networks with other parameters than before."""
    return {
        name
        for name, network in networks.items()
        if not all(map(torch.equal, network.parameters(), before[name].parameters()))
    }


def backpropagate(method: Method, batch: Batch, step: int) -> Losses:
    """The losses of the step; their weighted sum is backpropagated, and no optimizer steps."""
    losses = method.losses(batch, step)
    sum(weight * loss for weight, loss in losses.values()).backward()
    return losses
