"""One training in several processes: the rank of this one, its rows of each batch, sums over all of them.

Every process holds the same networks and data and takes the same steps. It differentiates its share of the loss; the
gradients are summed over the processes before an optimizer steps, so that all take the step of the whole batch.
docs/multi-process.md says what is equal to one process, and what is not.
"""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from learn3d.terminal import Stop


class LostPeerError(RuntimeError):
    """Another process of the group ended, or no longer answers."""


@dataclass(frozen=True, eq=False)
class ProcessGroup:
    """This process among the `world_size` processes of a training. `ProcessGroup()` is a training in one process.

    As in torch.distributed, all processes must make the same collective calls in the same order.
    """

    rank: int = 0
    world_size: int = 1
    rows: Tensor | None = None  # int64 [b]: the rows of every batch that are this process's own; None: all
    batch_share: float = 1.0  # b / B: the weight of this process's means
    local_world_size: int = 1  # processes on this machine
    backend: str = ""  # gloo, or NCCL for tensors on a GPU

    @property
    def is_main(self) -> bool:
        """Whether this is rank 0, the process that writes files and reports."""
        return self.rank == 0

    def split_batch(self, batch_size: int, views: int = 1) -> ProcessGroup:
        """The same process with its `rows` of batches of `batch_size`: consecutive ones, and all `views` of an object.

        A batch has the first view of all objects, then the second, and so on. Parts differ by at most one object.
        Raises ValueError if a process would have none.
        """
        if self.world_size == 1:
            return self
        objects = batch_size // views
        if objects < self.world_size:
            what = batch_size if views == 1 else f"{objects} objects with {views} views each"
            raise ValueError(
                f"a batch of {what} is too small for {self.world_size} processes; start at most {objects}, or choose a "
                "larger batch_size"
            )
        part = torch.arange(objects).tensor_split(self.world_size)[self.rank]
        rows = torch.cat([part + objects * view for view in range(views)])
        return dataclasses.replace(self, rows=rows, batch_share=len(rows) / batch_size)

    def all_reduce_moments(self, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and biased variance over the whole batch, from those over this process's rows. Differentiable."""
        if self.world_size == 1:
            return mean, variance
        first = mean.double()
        first, second = _AllReduce.apply(self.batch_share * torch.stack([first, variance.double() + first.square()]))
        return first.to(mean), (second - first.square()).clamp_min(0).to(variance)

    def all_reduce_mean(self, values: Mapping[str, float]) -> dict[str, float]:
        """Means over the whole batch, from means over this process's rows; NaN in one process is NaN in all."""
        if self.world_size == 1:
            return dict(values)
        means = _all_reduce(self.batch_share * torch.tensor(list(values.values()), dtype=torch.float64))
        return dict(zip(values, means.tolist(), strict=True))

    def all_gather(self, parts: list[Tensor], rows: Tensor, count: int) -> Tensor:
        """float64 [count, C]: `parts` [b, C] are this process's rows, numbers `rows`; others give the rest.

        Every row is the sum of one value and zeros, so it has the bits that a single process would compute.
        """
        if self.world_size == 1:
            return torch.cat(parts).double()
        width = int(self._all_reduce_max(parts[0].shape[1] if parts else 0))
        values = torch.zeros(count, width, dtype=torch.float64)
        if parts:
            values[rows] = torch.cat(parts).double()
        return _all_reduce(values)

    def all_gather_rows(self, values: Tensor, rows: Tensor, count: int) -> Tensor:
        """float [count, C]: `values` [b, C] are this process's rows, numbers `rows`. Differentiable."""
        if self.world_size == 1:
            return values
        return _AllReduce.apply(values.new_zeros((count, *values.shape[1:])).index_copy(0, rows, values))

    def stopped_by(self, stop: Stop) -> str:
        """The name of a signal that asked any of the processes to stop, or ""; the same in all of them."""
        if self.world_size == 1:
            return stop.name
        number = int(self._all_reduce_max(signal.Signals[stop.name] if stop.name else 0))
        return signal.Signals(number).name if number else ""

    @contextlib.contextmanager
    def main_process_first(self) -> Iterator[None]:
        """Rank 0 runs the body before the others enter it."""
        if not self.is_main:
            _all_reduce(torch.zeros(1))
        yield
        if self.is_main and self.world_size > 1:
            _all_reduce(torch.zeros(1))

    def check_equal(self, **values: object) -> None:
        """Raise a ValueError naming those of `values` that are not the same in all processes."""
        if self.world_size == 1:
            return
        checksums = torch.tensor([zlib.crc32(repr(value).encode()) for value in values.values()])
        extremes = _all_reduce(torch.stack([checksums, -checksums]), dist.ReduceOp.MAX).tolist()
        if differing := [name for name, high, low in zip(values, *extremes, strict=True) if high != -low]:
            raise ValueError(
                f"the processes of this run differ in {', '.join(differing)}; give all of them the same options, data "
                "and checkpoint, and the same versions on machines of one kind"
            )

    def _all_reduce_max(self, value: int) -> Tensor:
        return _all_reduce(torch.tensor(value), dist.ReduceOp.MAX)


SINGLE_PROCESS = ProcessGroup()


def weights_checksum(networks: Mapping[str, nn.Module]) -> int:
    """CRC-32 of all networks and of torch's random state, which must be the same in all processes."""
    checksum = zlib.crc32(torch.get_rng_state().numpy())
    for network in networks.values():
        for tensor in network.state_dict().values():
            checksum = zlib.crc32(tensor.detach().cpu().contiguous().numpy().reshape(-1).view("uint8"), checksum)
    return checksum


@torch.no_grad()
def all_reduce_gradients(optimizer: torch.optim.Optimizer, *_: Any) -> None:
    """Replace the gradients of an optimizer by their sums over the processes.

    Each is summed by itself: to copy all of them into one tensor and back takes as long as it saves, or longer.
    """
    gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
    for grad in gradients:
        if (total := _all_reduce(grad.contiguous())) is not grad:
            grad.copy_(total)


class _AllReduce(torch.autograd.Function):
    """The sum over all processes. Each one's loss depends on it, so its gradient is the sum of their gradients."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        return _all_reduce(values.contiguous().clone())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return _all_reduce(grad.contiguous().clone())


def _all_reduce(values: Tensor, op: Any = dist.ReduceOp.SUM) -> Tensor:
    """`torch.distributed.all_reduce` in place. Raises LostPeerError if a connection closes or nobody answers."""
    try:
        dist.all_reduce(values, op)
    except torch.cuda.OutOfMemoryError:
        raise
    except RuntimeError as error:
        raise LostPeerError(
            f"another process of the run failed, was killed or does not answer ({first_sentence(error)})"
        ) from None
    return values


def first_sentence(error: Exception) -> str:
    """The first sentence of an error of torch's, without the advice and the stack of calls that follow."""
    return str(error).strip().split("\n")[0].split(". ")[0]
