"""Trains what the tasks of a JSON file say, with tiny networks, in the ranks that torchrun started or in one process.

A task has "config" and may have "resume"; "rate": steps are so many times the gradient, instead of Adam's; and "kill":
[rank, step] of the process that kills itself before that step.
"""

from __future__ import annotations

import functools
import json
import os
import signal
import sys
from pathlib import Path

import tiny_networks
import torch

from learn3d import training
from learn3d.distributed import join_ranks, rank
from learn3d.methods import mesh_method
from learn3d.networks.encoders import ENCODERS
from learn3d.presets import config_from_dict
from learn3d.runs import checkpoint
from learn3d.terminal import without_traceback


def linear(
    rate: float, network: torch.nn.Module, learning_rate: float, betas: object = None
) -> torch.optim.Optimizer:
    """Adam with so large an eps that its steps are `rate` times the gradient.

    Otherwise its first steps have the size of the learning rate, even if the gradient is nothing but rounding.
    """
    eps = 1e4
    return torch.optim.Adam(
        [p for p in network.parameters() if p.requires_grad], lr=rate * eps, eps=eps
    )


def step(take_step, kill, method, batch, now):
    if kill == [rank(), now]:
        os.kill(os.getpid(), signal.SIGKILL)
    return take_step(method, batch, now)


@without_traceback
def main() -> int:
    tiny_networks.put_in_place()
    training.PICTURE_ROWS = 1
    checkpoint._git_commit = lambda: None  # a commit made during the tests does not tell runs apart
    take_step, adam = training.take_step, mesh_method.adam
    with join_ranks("cpu"):
        for task in json.loads(Path(sys.argv[1]).read_text()):
            training.take_step = functools.partial(step, take_step, task.get("kill"))
            rate = task.get("rate")
            mesh_method.adam = functools.partial(linear, rate) if rate else adam
            training.train(config_from_dict(task["config"]), resume=task.get("resume", False))
    return 0


if __name__ == "__main__":
    ENCODERS["conv-light"] = tiny_networks.TinyEncoder
    sys.exit(main())
