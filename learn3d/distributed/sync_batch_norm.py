"""Batch norm over the rows of all processes."""

from __future__ import annotations

import functools

import torch
from torch import Tensor, nn

from learn3d.distributed.process_group import ProcessGroup

BatchNorm = nn.BatchNorm1d | nn.BatchNorm2d | nn.BatchNorm3d


def convert_sync_batchnorm(network: nn.Module, group: ProcessGroup) -> None:
    """Let the batch norms of a network take mean and variance over the rows of all processes, in place.

    `nn.SyncBatchNorm` works on CUDA devices only, and for parts of equal size. The modules keep their names, so that
    checkpoints stay the same.
    """
    for module in network.modules():
        if isinstance(module, BatchNorm):
            module.forward = functools.partial(_forward, module, group)


def _forward(norm: BatchNorm, group: ProcessGroup, x: Tensor) -> Tensor:
    if not norm.training:
        return type(norm).forward(norm, x)
    shape = [1, -1] + [1] * (x.ndim - 2)
    values = x.float()
    variance, mean = torch.var_mean(values, [0, *range(2, x.ndim)], correction=0)
    mean, variance = group.all_reduce_moments(mean, variance)
    count = round(x.numel() / x.shape[1] / group.batch_share)
    with torch.no_grad():
        norm.num_batches_tracked.add_(1)
        norm.running_mean.lerp_(mean, norm.momentum)
        norm.running_var.lerp_(variance * count / max(1, count - 1), norm.momentum)
    scale = norm.weight * (variance + norm.eps).rsqrt()
    return ((values - mean.view(shape)) * scale.view(shape) + norm.bias.view(shape)).to(x.dtype)
