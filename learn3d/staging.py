"""Tensors on their way between the device of the networks and the CPU, where rendering runs, without stopping either.

From and to a GPU they go through page-locked memory, so that the CPU only queues the copy and goes on. On the CPU there
is nothing to do: every function hands on the tensor that it was given, and the same code runs everywhere.
"""

from __future__ import annotations

import torch
from torch import Tensor


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor on the CPU as one on `device`, in the order of what is queued there; its gradient comes back."""
    if device.type == "cpu" or tensor.device.type != "cpu":
        return tensor.to(device)
    return _Uploaded.apply(tensor, device)


class Download:
    """The copy of a tensor to the CPU, started when this is made. What is queued on the device afterwards runs on."""

    def __init__(self, tensor: Tensor) -> None:
        self._tensor = tensor
        self._copy, self._arrived = _start_copy(tensor.detach())

    def wait(self) -> Tensor:
        """The tensor on the CPU, as soon as it is there. Gradients of it go to the original."""
        if self._arrived is None:
            return self._tensor
        return _Downloaded.apply(self._tensor, self)

    def finish(self) -> Tensor:
        """The copy itself, without gradient."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return self._copy


def _start_copy(tensor: Tensor) -> tuple[Tensor, torch.cuda.Event | None]:
    """The copy, and the event after which it is complete; None where there was nothing to copy."""
    if tensor.device.type == "cpu":
        return tensor, None
    copy = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
    copy.copy_(tensor, non_blocking=True)
    arrived = torch.cuda.Event()
    arrived.record(torch.cuda.current_stream(tensor.device))
    return copy, arrived


def _send(tensor: Tensor, device: torch.device) -> Tensor:
    return tensor.detach().contiguous().pin_memory().to(device, non_blocking=True)


class _Uploaded(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor: Tensor, device: torch.device) -> Tensor:
        return _send(tensor, device)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        return Download(grad).finish(), None


class _Downloaded(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor: Tensor, download: Download) -> Tensor:
        ctx.device = tensor.device
        return download.finish()

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        return _send(grad, ctx.device), None
