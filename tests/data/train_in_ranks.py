"""One process of several: does what the tasks of a JSON file say, one after the other. Started by test_ranks.py.

{"config": ..., "resume": false}     train; `linear` with steps linear in the gradient, `fault`: see `inject`
{"evaluate": folder}                 evaluate the last checkpoint of a run, in chunks of 5 images
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import tiny_networks
import torch

import nmr
from learn3d import validation
from learn3d.config import config_from_dict
from learn3d.distributed.launch import init_process_group
from learn3d.distributed.process_group import SINGLE_PROCESS, ProcessGroup
from learn3d.evaluation import Evaluation, evaluate
from learn3d.methods import method, prgan, vpl
from learn3d.runs import checkpoint
from learn3d.training import load_splits, train


@contextlib.contextmanager
def linear_optimizer() -> Iterator[None]:
    """Adam with so large an eps that its steps are linear in the gradient: rounding then changes the weights as little.

    Otherwise Adam's first steps have the size of the learning rate, whatever that of the gradient: where it is nothing
    but rounding (a bias before a batch norm, a unit that is off) their direction is chance.
    """

    def linear(network: torch.nn.Module, learning_rate: float, betas: object = None) -> torch.optim.Optimizer:
        eps = 1e4
        return torch.optim.Adam([p for p in network.parameters() if p.requires_grad], lr=3e-3 * eps, eps=eps)

    with contextlib.ExitStack() as stack:
        for module in (method, prgan, vpl):
            stack.enter_context(mock.patch.object(module, "adam", linear))
        yield


def inject(fault: str, stack: contextlib.ExitStack) -> None:
    """nan: a loss that is none. error: an exception of the kind that nobody expects, in a step."""

    def fail(*_: object) -> torch.Tensor:
        if fault == "error":
            raise RuntimeError("the cat is on the keyboard")
        return torch.tensor(float("nan"), requires_grad=True)

    stack.enter_context(mock.patch.object(nmr.losses, "soft_iou_loss", fail))


def evaluate_last(folder: Path, group: ProcessGroup = SINGLE_PROCESS) -> Evaluation:
    method, config, _ = checkpoint.load_method(folder / "last.safetensors")
    method.distribute(group)
    return evaluate(method, load_splits(config)[1], batch_size=5)


def run(task: dict, group: ProcessGroup) -> None:
    if "evaluate" in task:
        result = evaluate_last(Path(task["evaluate"]), group)
        if group.is_main:
            summary = result.means | {"ious": result.values["voxel_iou"].tolist()}
            Path(task["evaluate"], "evaluation.json").write_text(json.dumps(summary))
        return
    config = config_from_dict(task["config"])
    with contextlib.ExitStack() as stack:
        if task.get("linear"):
            stack.enter_context(linear_optimizer())
        if group.rank == 1 and "fault" in task:
            inject(task["fault"], stack)
        if group.rank == 1 and "seed_of_rank_1" in task:
            config = dataclasses.replace(config, seed=task["seed_of_rank_1"])
        train(config, resume=task.get("resume", False), group=group)


def main() -> None:
    tiny_networks.put_in_place()
    validation.PICTURE_ROWS = 1
    tasks = json.loads(Path(sys.argv[1]).read_text())
    with init_process_group(tasks[0]["config"]["device"]) as group:
        for task in tasks:
            try:
                run(task, group)
            except (ValueError, FloatingPointError) as error:  # those that all processes raise together
                if "raises" not in task or task["raises"] not in str(error):
                    raise
    if Path("/proc/self/task").is_dir():  # threads that outlive the group abort the process as it ends, now and then
        names = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
        assert not [name for name in names if "gloo" in name], names


if __name__ == "__main__":
    main()
