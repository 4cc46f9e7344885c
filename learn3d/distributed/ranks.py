"""One run in several processes: who this one is, which part of each batch is its own, what they tell each other.

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

LARGE = 1 << 18  # entries of a gradient that is summed in place; smaller ones travel together


class LostPeerError(RuntimeError):
    """Another process of the job ended, or no longer answers."""


@dataclass(frozen=True, eq=False)
class Ranks:
    """This process among the `world` processes of a run. `Ranks()` is a run of one process: nothing is exchanged.

    All processes must call the functions that exchange something equally often and in the same order.
    """

    rank: int = 0
    world: int = 1
    rows: Tensor | None = None  # int64 [b]: the rows of every batch that are this process's own; None: all
    share: float = 1.0  # of the batch: the weight of this process's means
    local_world: int = 1  # processes on this machine
    backend: str = ""  # what exchanges tensors: gloo, or NCCL for those on a GPU

    @property
    def alone(self) -> bool:
        """Whether this is the only process."""
        return self.world == 1

    @property
    def main(self) -> bool:
        """Whether this is the process that writes files and reports."""
        return self.rank == 0

    def divide(self, batch_size: int, sampling: str) -> Ranks:
        """The same process with its rows of batches of `batch_size`: consecutive ones, and both views of a pair.

        Parts differ by at most one row (or pair). Raises ValueError where a process would have none.
        """
        if self.alone:
            return self
        half = batch_size // 2 if sampling == "pairs" else 0
        rows = torch.arange(half or batch_size).tensor_split(self.world)[self.rank]
        if (half or batch_size) < self.world:
            raise ValueError(
                f"a batch of {f'{half} pairs' if half else batch_size} is too small for {self.world} processes; "
                f"start at most {half or batch_size}, or choose a larger batch_size"
            )
        if half:
            rows = torch.cat([rows, rows + half])
        return dataclasses.replace(self, rows=rows, share=len(rows) / batch_size)

    def pool(self, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and biased variance over the whole batch, of those over this process's rows.

        Differentiable, where each process differentiates its share of a loss.
        """
        if self.alone:
            return mean, variance
        first = mean.double()
        first, second = _Sum.apply(self.share * torch.stack([first, variance.double() + first.square()]))
        return first.to(mean), (second - first.square()).clamp_min(0).to(variance)

    def means(self, losses: Mapping[str, float]) -> dict[str, float]:
        """Losses of the whole batch, of those of this process's rows. One that is not finite anywhere is so for all."""
        if self.alone:
            return dict(losses)
        values = _all_reduce(self.share * torch.tensor(list(losses.values()), dtype=torch.float64))
        return dict(zip(losses, values.tolist(), strict=True))

    def stopped_by(self, stop: Stop) -> str:
        """The name of a signal that asked any of the processes to stop, or ""; the same in all of them."""
        if self.alone:
            return stop.name
        number = int(self._largest(signal.Signals[stop.name] if stop.name else 0))
        return signal.Signals(number).name if number else ""

    def gather(self, parts: list[Tensor], rows: Tensor, count: int) -> Tensor:
        """float64 [count] or [count, C]: the rows `rows` are this process's `parts`, the rest are those of the others.

        Nothing but zeros is added to any row, so it has the bits that one process would have given it.
        """
        if self.alone:
            return torch.cat(parts).double()
        width = int(self._largest(parts[0].shape[1] if parts and parts[0].ndim == 2 else 0))
        values = torch.zeros((count, width) if width else count, dtype=torch.float64)
        if parts:
            values[rows] = torch.cat(parts).double()
        return _all_reduce(values)

    def join_rows(self, values: Tensor, rows: Tensor, count: int) -> Tensor:
        """float [count, C]: the rows of all processes, of which `values` [b, C] are this one's, numbers `rows`.

        Differentiable, where each process differentiates its share of a loss.
        """
        if self.alone:
            return values
        padded = values.new_zeros((count, *values.shape[1:])).index_copy(0, rows, values)
        return _Sum.apply(padded)

    def any(self, value: bool) -> bool:
        """Whether it is true in at least one process."""
        return value if self.alone else bool(self._largest(int(value)))

    @contextlib.contextmanager
    def main_first(self) -> Iterator[None]:
        """The first process goes through the body before the others enter it."""
        if not self.main:
            _all_reduce(torch.zeros(1))
        yield
        if self.main and not self.alone:
            _all_reduce(torch.zeros(1))

    def check_same(self, **values: object) -> None:
        """Raise a ValueError naming those of `values` that are not the same in all processes."""
        if self.alone:
            return
        sums = torch.tensor([zlib.crc32(repr(value).encode()) for value in values.values()])
        both = _all_reduce(torch.stack([sums, -sums]), dist.ReduceOp.MAX)
        if differing := [name for name, high, low in zip(values, *both.tolist(), strict=True) if high != -low]:
            raise ValueError(
                f"the processes of this run differ in {', '.join(differing)}; give all of them the same options, data "
                "and checkpoint, and the same versions on machines of one kind"
            )

    def _largest(self, value: int) -> Tensor:
        return _all_reduce(torch.tensor(value), dist.ReduceOp.MAX)


ALONE = Ranks()


def weights_digest(networks: Mapping[str, nn.Module]) -> int:
    """A checksum of all networks and of torch's random state: what must be the same in all processes."""
    digest = zlib.crc32(torch.get_rng_state().numpy())
    for network in networks.values():
        for tensor in network.state_dict().values():
            digest = zlib.crc32(tensor.detach().cpu().contiguous().numpy().reshape(-1).view("uint8"), digest)
    return digest


class _Sum(torch.autograd.Function):
    """Every process's loss depends on the sum: the gradient of a summand is the sum of their gradients."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        return _all_reduce(values.contiguous().clone())

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return _all_reduce(grad.contiguous().clone())


@torch.no_grad()
def sum_gradients(optimizer: torch.optim.Optimizer, *_: Any) -> None:
    """Replace the gradients of an optimizer by their sums over the processes.

    Large ones are summed where they are, the others in one piece: to copy them all takes as long as to send them.
    """
    gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
    small = [grad for grad in gradients if grad.numel() < LARGE or not grad.is_contiguous()]
    for grad in gradients:
        if grad.numel() >= LARGE and grad.is_contiguous():
            _all_reduce(grad)
    if small:
        bucket = _all_reduce(torch.cat([grad.reshape(-1) for grad in small]))
        for grad, total in zip(small, bucket.split([grad.numel() for grad in small]), strict=True):
            grad.copy_(total.view(grad.shape))


def _all_reduce(values: Tensor, op: Any = dist.ReduceOp.SUM) -> Tensor:
    """The values of all processes, summed (or otherwise combined) in place."""
    try:
        dist.all_reduce(values, op)
    except torch.cuda.OutOfMemoryError:
        raise
    except RuntimeError as error:  # a closed connection, or nobody answered in time
        raise LostPeerError(
            f"another process of the run failed, was killed or does not answer ({first_sentence(error)})"
        ) from None
    return values


def first_sentence(error: Exception) -> str:
    """What torch says, without the advice and the stack of calls that follow."""
    return str(error).strip().split("\n")[0].split(". ")[0]
