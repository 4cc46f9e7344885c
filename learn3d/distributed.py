"""One training in several ranks, the processes that torchrun starts: what a rank needs beside
torch.distributed.

Every rank holds the same networks and takes the same steps. It draws all random numbers of a step
for the whole batch and computes the losses of its own rows. Its share of a loss is 1 / W of its
mean, with W ranks, so the sums of the ranks' gradients are the gradients of the whole batch.
Without torchrun there is one rank.
"""

import contextlib
import dataclasses
import os
from collections.abc import Iterable, Iterator
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from learn3d.data.dataset import Batch
from learn3d.terminal import stop_on_signal

TIMEOUT = timedelta(seconds=50)  # time that a rank waits in a step for the others
# the same for others that read data or save a checkpoint
SLOW_TIMEOUT = timedelta(minutes=30)


def world_size() -> int:
    """The number of ranks, W."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """The number of this process in 0 .. W-1. Rank 0 writes all files."""
    return dist.get_rank() if dist.is_initialized() else 0


def describe() -> str:
    """The number of ranks, for the first line of a run's log; "" for one."""
    return f" in each of {world_size()} ranks ({dist.get_backend()})" if world_size() > 1 else ""


@contextlib.contextmanager
def join_ranks(device: str) -> Iterator[None]:
    """Context in which this process is one of the ranks that torchrun started, if it did.

    Ranks use gloo for tensors on the CPU, and NCCL on GPUs, of which each needs its own. Raises
    OSError if the ranks do not find each other, ValueError if this machine has too few GPUs.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    if device == "cuda":
        found, wanted = torch.cuda.device_count(), int(os.environ["LOCAL_WORLD_SIZE"])
        if found < wanted:
            raise ValueError(
                f"{wanted} ranks need {wanted} GPUs on this machine, got {found}; start fewer ranks"
            )
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    with _lost_ranks():
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if device == "cuda" else "gloo", timeout=TIMEOUT
        )
        global _patient
        _patient = dist.new_group(backend="gloo", timeout=SLOW_TIMEOUT)
    with (
        stop_on_signal()
    ):  # torchrun sends SIGTERM if another rank has ended; this one says so by itself
        yield
    dist.destroy_process_group()


@contextlib.contextmanager
def _lost_ranks() -> Iterator[None]:
    """Turn torch's errors for a lost connection or a timeout into a sentence."""
    try:
        yield
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0].split(". ")[0]
        raise OSError(f"rank {rank()}: another rank ended or does not answer ({reason})") from None


def own_rows(batch_size: int, views: int) -> Tensor:
    """The rows of a batch [a_1 .. a_n, b_1 .. b_n, ...] that this rank takes, int64 [b].

    They are all `views` of consecutive objects. All ranks take equally many objects, and an even
    number, because methods may flip every second image. Raises ValueError if the batch cannot be
    divided so.
    """
    objects = batch_size // views
    if world_size() > 1 and objects % (2 * world_size()):
        wanted = (
            f"batch_size must be a multiple of {2 * world_size() * views} for {world_size()} ranks"
        )
        raise ValueError(f"{wanted}, which take equal and even parts of a batch, got {batch_size}")
    return torch.arange(objects * views).view(views, world_size(), -1)[:, rank()].flatten()


def all_gather_objects(value: Any, *, patient: bool = False) -> list[Any]:
    """The values of all ranks, by rank. patient: wait for `SLOW_TIMEOUT`."""
    if world_size() == 1:
        return [value]
    found = [None] * world_size()
    with _lost_ranks():
        dist.all_gather_object(found, value, group=_patient if patient else None)
    return found


def check_same(**values: Any) -> None:
    """Raise a ValueError that names those of the values that differ between the ranks."""
    everywhere = all_gather_objects(values, patient=True)
    if different := [
        name for name in values if any(found[name] != values[name] for found in everywhere)
    ]:
        advice = "give all ranks the same options, data and output folder, on a disk that all machines share"
        raise ValueError(f"the ranks of this run differ in {', '.join(different)}; {advice}")


def mean_losses(losses: dict[str, float], stopped_by: str) -> tuple[dict[str, float], str]:
    """Means of the losses over all ranks, and the name of a signal that stops one of them or ""."""
    everywhere = all_gather_objects((losses, stopped_by))
    means = {name: sum(found[name] for found, _ in everywhere) / world_size() for name in losses}
    return means, max(name for _, name in everywhere)


def whole_batch(batch: Batch) -> Batch:
    """The batch with poses and view classes of all ranks' rows."""
    if world_size() == 1:
        return batch
    poses, view_ids = zip(*all_gather_objects((batch.poses, batch.view_ids)), strict=True)
    return dataclasses.replace(batch, poses=poses[0].join(poses), view_ids=torch.cat(view_ids))


def _all_reduce(values: Tensor) -> Tensor:
    """The sum over all ranks."""
    total = values.clone(memory_format=torch.contiguous_format)
    with _lost_ranks():
        dist.all_reduce(total)
    return total


class _AllReduce(torch.autograd.Function):
    """The sum over all ranks.

    The loss of every rank depends on it, so its gradient is the sum of their gradients.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        return _all_reduce(values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return _all_reduce(grad)


def all_reduce_mean(values: Tensor) -> Tensor:
    """The mean of a tensor over all ranks, differentiable."""
    return values if world_size() == 1 else _AllReduce.apply(values / world_size())


def all_gather(rows: Tensor) -> Tensor:
    """float [B, ...]: the rows [b, ...] of all ranks, by rank; differentiable."""
    if world_size() == 1:
        return rows
    empty = torch.zeros_like(rows)
    return _AllReduce.apply(
        torch.cat([rows if number == rank() else empty for number in range(world_size())])
    )


def check_networks(networks: nn.Module) -> None:
    """Raise ValueError if several ranks train networks with batch norms.

    Each rank would normalise by the statistics of its own rows, and `nn.SyncBatchNorm` works on
    GPUs only.
    """
    norms = any(isinstance(m, nn.modules.batchnorm._BatchNorm) for m in networks.modules())
    if norms and world_size() > 1:
        raise ValueError(
            "networks with batch norms (encoder resnet18, VPL, PrGAN) train in one process, got "
            f"{world_size()} ranks; start learn3d train without torchrun"
        )


def synchronize(networks: nn.Module, optimizers: Iterable[torch.optim.Optimizer]) -> None:
    """Let optimizers step on the sums of all ranks' gradients.

    DistributedDataParallel works with one backward pass a step only.
    """
    if world_size() == 1:
        return
    pending = []

    def send(parameter: nn.Parameter) -> None:
        with _lost_ranks():
            pending.append(dist.all_reduce(parameter.grad, async_op=True))

    def receive(*_: Any) -> None:
        with _lost_ranks():
            while pending:
                pending.pop().wait()

    for parameter in networks.parameters():
        if parameter.requires_grad:
            parameter.register_post_accumulate_grad_hook(send)
    for optimizer in optimizers:
        optimizer.register_step_pre_hook(receive)


def wait_for_writer() -> None:
    """Wait until rank 0 has saved a checkpoint."""
    all_gather_objects(None, patient=True)


_patient: Any = None  # the group of all ranks whose operations wait for `SLOW_TIMEOUT`
