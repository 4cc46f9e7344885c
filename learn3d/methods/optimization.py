"""Optimization in every method: learning-rate schedules, EMA and Adam."""

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

LRSchedule = Literal["constant", "cosine", "linear", "step"]


@dataclass(frozen=True)
class TrainingSchedule:
    """Length, learning-rate schedule and EMA of a run; `TrainConfig` explains the options."""

    iterations: int = 1
    lr_schedule: LRSchedule = "constant"
    warmup_steps: int = 0
    ema_decay: float = 0.0

    def __post_init__(self) -> None:
        if self.iterations <= self.warmup_steps:
            raise ValueError(
                f"warmup_steps must be below the {self.iterations} iterations, got {self.warmup_steps}"
            )
        self.lr_factor(self.warmup_steps + 1)  # raises ValueError for an unknown schedule

    def lr_factor(self, step: int) -> float:
        """The learning rate of step `step` (from 1), as a share of the full one.

        It is 1/w, 2/w .. 1 in a warm-up of w steps. After it, constant: 1. linear, cosine: from 1
        towards 0. step: 1, and 0.1 in the last 5 % of all iterations (Kato et al. 2018).
        """
        if step <= self.warmup_steps:
            return step / self.warmup_steps
        # 0 .. below 1
        done = (step - 1 - self.warmup_steps) / (self.iterations - self.warmup_steps)
        if self.lr_schedule == "linear":
            return 1 - done
        if self.lr_schedule == "cosine":
            return (1 + math.cos(math.pi * done)) / 2
        if self.lr_schedule == "step":
            return 0.1 if 20 * step > 19 * self.iterations else 1.0
        if self.lr_schedule == "constant":
            return 1.0
        raise ValueError(
            f"the schedule {self.lr_schedule!r} has no branch in TrainingSchedule.lr_factor"
        )


class EMA:
    """Exponential moving average of all parameters and floating-point buffers of networks.

    After step t: average = d * average + (1 - d) * weights, so that the initial weights are soon
    forgotten; d = min(decay, (1 + t) / (10 + t)).
    """

    def __init__(self, networks: nn.Module, decay: float) -> None:
        self.decay = decay
        self._own = networks.state_dict(keep_vars=True)
        self.tensors = {name: value.detach().clone() for name, value in self._own.items()}

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Update the average after step `step` (from 1)."""
        new = 1 - min(self.decay, (1 + step) / (10 + step))
        for name, average in self.tensors.items():
            if average.is_floating_point():
                average.lerp_(self._own[name].detach(), new)
            else:  # a batch norm's number of batches
                average.copy_(self._own[name])

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        """Context in which the networks have the averaged weights, for evaluation only."""
        self._swap()
        try:
            yield
        finally:
            self._swap()

    def _swap(self) -> None:
        for name, own in self._own.items():
            own.data, self.tensors[name] = self.tensors[name], own.data


def adam(
    network: nn.Module, learning_rate: float, betas: tuple[float, float] = (0.9, 0.999)
) -> torch.optim.Adam:
    """Adam for one network: fused (13 ms a step, not 91), and without denormal moments."""
    parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]
    optimizer = torch.optim.Adam(parameters, lr=learning_rate, betas=betas, fused=True)
    optimizer.register_step_post_hook(_drop_vanished)
    return optimizer


@torch.no_grad()
def _drop_vanished(optimizer: torch.optim.Optimizer, *_: object) -> None:
    """Every 20 steps, set moments that are far too small to change a weight to 0.

    The gradient of a dead unit is 0, so its moments decay until they are denormal. Some CPUs are
    many times slower with denormal numbers: Adam took 111 ms a step of Plus instead of 15.
    """
    for parameter, state in optimizer.state.items():
        if parameter.device.type == "cpu" and state["step"] % 20 == 0:
            for name, least in (
                ("exp_avg", 1e-20),
                ("exp_avg_sq", 1e-36),
            ):  # beside eps = 1e-8, and its square
                torch.hardshrink(state[name], least, out=state[name])


def frozen(network: nn.Module, *inputs: Tensor) -> Tensor:
    """Apply a network; gradients reach its inputs alone, and its buffers do not change."""
    state = {name: parameter.detach() for name, parameter in network.named_parameters()}
    state |= {name: buffer.clone() for name, buffer in network.named_buffers()}
    return torch.func.functional_call(network, state, inputs)
