"""Trains what the tasks of a JSON file say, with tiny networks, in the ranks that torchrun started or in one process.

A task has "config" and may have "resume"; "linear": true for steps that are linear in the gradient; and "kill": [rank,
step] of the process that kills itself before that step.
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
from learn3d.config import config_from_dict
from learn3d.methods import mesh_method, prgan
from learn3d.networks.encoders import ENCODERS
from learn3d.runs.distributed import join_ranks, rank
from learn3d.terminal import without_traceback


def linear(network: torch.nn.Module, learning_rate: float, betas: object = None) -> torch.optim.Optimizer:
    """Adam with so large an eps that its steps are linear in the gradient.

    Otherwise its first steps have the size of the learning rate, even if the gradient is nothing but rounding.
    """
    eps = 1e4
    return torch.optim.Adam([p for p in network.parameters() if p.requires_grad], lr=3e-3 * eps, eps=eps)


def step(take_step, kill, method, batch, now):
    if kill == [rank(), now]:
        os.kill(os.getpid(), signal.SIGKILL)
    return take_step(method, batch, now)


@without_traceback
def main() -> int:
    tiny_networks.put_in_place()
    training.PICTURE_ROWS = 1
    take_step, adam = training.take_step, mesh_method.adam
    with join_ranks("cpu"):
        for task in json.loads(Path(sys.argv[1]).read_text()):
            training.take_step = functools.partial(step, take_step, task.get("kill"))
            mesh_method.adam = prgan.adam = linear if task.get("linear") else adam
            training.train(config_from_dict(task["config"]), resume=task.get("resume", False))
    return 0


if __name__ == "__main__":
    ENCODERS["conv-relu"] = ENCODERS["conv-light"] = tiny_networks.TinyEncoder
    sys.exit(main())
