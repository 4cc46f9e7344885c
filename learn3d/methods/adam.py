"""The Adam of Kato et al. 2018, which skips weights without a gradient."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

CHUNK = 1 << 20  # weights that are updated at once


class SparseGradientAdam(torch.optim.Adam):
    """Adam without an update, of the moments too, for every single weight whose gradient is exactly zero in this step.

    The published code trains with it. The weights of a ReLU that is off for a whole batch have zero gradients in that
    step. Adam would carry them on by their momentum and forget their second moment.
    As in Chainer, epsilon is added before the bias correction of the second moment: lr' m / (sqrt(v) + eps), with
    lr' = lr sqrt(1 - beta_2^t) / (1 - beta_1^t), and all weights share the count t. The state is that of torch's Adam.
    """

    def __init__(self, params: Iterable[Tensor], lr: float) -> None:
        super().__init__(params, lr=lr)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        with torch.enable_grad():
            loss = closure() if closure is not None else None
        for group in self.param_groups:
            for parameter in (p for p in group["params"] if p.grad is not None):
                state = self.state[parameter]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                state["step"] += 1
                self._update(parameter, state, group)
        return loss

    def _update(self, parameter: Tensor, state: dict[str, Tensor], group: dict) -> None:
        """Update in chunks that share two buffers: allocating more takes five times as long as computing."""
        (beta1, beta2), count = group["betas"], float(state["step"])
        rate = group["lr"] * math.sqrt(1 - beta2**count) / (1 - beta1**count)
        row = parameter[0].numel()
        rows = max(1, CHUNK // row)
        memory = parameter.new_empty(2, min(rows, len(parameter)) * row)
        tensors = (parameter, parameter.grad, state["exp_avg"], state["exp_avg_sq"])
        for weight, grad, first, second in zip(*(tensor.split(rows) for tensor in tensors), strict=True):
            touched, change = (part[: weight.numel()].view(weight.shape) for part in memory)
            touched.copy_(grad).ne_(0)
            torch.sub(grad, first, out=change)
            first.addcmul_(touched, change, value=1 - beta1)
            torch.mul(grad, grad, out=change).sub_(second)
            second.addcmul_(touched, change, value=1 - beta2)
            torch.sqrt(second, out=change).add_(group["eps"])
            weight.addcdiv_(touched.mul_(first), change, value=-rate)
