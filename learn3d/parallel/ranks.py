"""One run in several processes: who this one is, which part of each batch is its own, what they tell each other.

Every process holds the same networks and data and takes the same steps. It differentiates its share of the loss; the
gradients are summed over the processes before an optimizer steps, so that all take the step of the whole batch.
docs/multi-process.md says what is equal to one process, and what is not.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import socket
import time
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed as dist
import torch.distributed.nn.functional  # keeps the group that it finds, and so its threads: before there is one
from torch import Tensor
from torch.distributed.rendezvous import rendezvous

from learn3d.device import check_device
from learn3d.parallel.whole_batch_norm import use_whole_batch

if TYPE_CHECKING:
    from learn3d.data.sampling import Sampling
    from learn3d.interrupt import Stop
    from learn3d.methods import Method

TIMEOUT = timedelta(minutes=10)  # how long a process waits for the others before it gives up
LAST_WORDS = 2.0  # seconds that a process which ends because of another one leaves it, to be seen as the cause
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
    beside: int = 1  # processes on this machine, with this one
    backend: str = ""  # what exchanges tensors: gloo, or NCCL for those on a GPU

    @property
    def alone(self) -> bool:
        """Whether this is the only process."""
        return self.world == 1

    @property
    def main(self) -> bool:
        """Whether this is the process that writes files and reports."""
        return self.rank == 0

    def divide(self, batch_size: int, sampling: Sampling) -> Ranks:
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

    def sum(self, values: Tensor) -> Tensor:
        """The sum over the processes; differentiable, where each process differentiates its share of a loss."""
        return values if self.alone else _Sum.apply(values)

    def pool(self, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and biased variance over the whole batch, of those over this process's rows; differentiable."""
        if self.alone:
            return mean, variance
        first = mean.double()
        first, second = self.sum(self.share * torch.stack([first, variance.double() + first.square()]))
        return first.to(mean), (second - first.square()).clamp_min(0).to(variance)

    def means(self, losses: Mapping[str, float]) -> dict[str, float]:
        """Losses of the whole batch, of those of this process's rows. One that is not finite anywhere is so for all."""
        if self.alone:
            return dict(losses)
        values = self.share * torch.tensor(list(losses.values()), dtype=torch.float64)
        _all_reduce(values)
        return dict(zip(losses, values.tolist(), strict=True))

    def stopped_by(self, stop: Stop) -> str:
        """The name of a signal that asked any of the processes to stop, or ""; the same in all of them."""
        if self.alone:
            return stop.name
        number = torch.tensor(signal.Signals[stop.name] if stop.name else 0)
        _all_reduce(number, dist.ReduceOp.MAX)
        return signal.Signals(int(number)).name if number else ""

    def gather(self, parts: list[Tensor], rows: Tensor, count: int) -> Tensor:
        """float64 [count] or [count, C]: the rows `rows` are this process's `parts`, the rest are those of the others.

        Nothing but zeros is added to any row, so it has the bits that one process would have given it.
        """
        if self.alone:
            return torch.cat(parts).double()
        width = torch.tensor(parts[0].shape[1] if parts and parts[0].ndim == 2 else 0)
        _all_reduce(width, dist.ReduceOp.MAX)
        values = torch.zeros((count, int(width)) if width else count, dtype=torch.float64)
        if parts:
            values[rows] = torch.cat(parts).double()
        _all_reduce(values)
        return values

    def any(self, value: bool) -> bool:
        """Whether it is true in at least one process."""
        if self.alone:
            return value
        found = torch.tensor(float(value))
        _all_reduce(found, dist.ReduceOp.MAX)
        return bool(found)

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
        both = torch.stack([sums, -sums])
        _all_reduce(both, dist.ReduceOp.MAX)
        if differing := [name for name, high, low in zip(values, *both.tolist(), strict=True) if high != -low]:
            raise ValueError(
                f"the processes of this run differ in {', '.join(differing)}; give all of them the same options, data "
                "and checkpoint, and the same versions on machines of one kind"
            )

    def join(self, method: Method) -> None:
        """Let a method learn from the whole batch: gradients are summed, batch norms see all rows."""
        method.ranks = self
        if self.alone:
            return
        for network in method.networks.values():
            use_whole_batch(network, self)
        for optimizer in method.optimizers.values():
            optimizer.register_step_pre_hook(sum_gradients)


ALONE = Ranks()


@contextlib.contextmanager
def start(device: str) -> Iterator[Ranks]:
    """This process among those that torchrun started, or `ALONE` where nobody did.

    With the device cuda each process of a machine takes a GPU of its own, and NCCL sums on it. Where on any machine
    there are more processes than GPUs they share them, and all sum over gloo. When the body raises, the other processes
    are told why.
    """
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield ALONE
        return
    if missing := [name for name in ("RANK", "MASTER_ADDR", "MASTER_PORT") if name not in os.environ]:
        raise ValueError(f"WORLD_SIZE is {world}, but {', '.join(missing)} is not set; start the processes by torchrun")
    rank, beside, own_gpu = int(os.environ["RANK"]), int(os.environ.get("LOCAL_WORLD_SIZE", "1")), False
    check_device(device)
    if device == "cuda":
        gpus, local = torch.cuda.device_count(), int(os.environ.get("LOCAL_RANK", "0"))
        torch.cuda.set_device(local % gpus)
        own_gpu = beside <= gpus
    try:
        store, _, _ = next(rendezvous("env://", rank, world, timeout=TIMEOUT))
        store = dist.PrefixStore(_attempt(), store)
        backend = "cpu:gloo,cuda:nccl" if all_agree(store, rank, world, own_gpu) else "gloo"
        own = dist.PrefixStore("run", store)
        dist.init_process_group(backend, store=own, rank=rank, world_size=world, timeout=TIMEOUT)
    except RuntimeError as error:
        raise LostPeerError(
            f"the {world} processes of the run did not find each other by {os.environ['MASTER_ADDR']}:"
            f"{os.environ['MASTER_PORT']} ({_first_sentence(error)}); one of them has ended before (it says why), or "
            "the machines do not reach each other (docs/multi-process.md)"
        ) from None
    try:
        yield Ranks(rank, world, beside=beside, backend="gloo" if backend == "gloo" else "NCCL")
    except BaseException as error:
        said = _announce(store, error)
        # Not NCCL's group, nor one whose sum was interrupted: they might wait for the others.
        if backend == "gloo" and isinstance(error, Exception):
            dist.destroy_process_group()
        if said:
            raise SystemExit(1) from None
        raise
    dist.destroy_process_group()


def _attempt() -> str:
    """A name of this attempt's own in the store, which torchrun keeps when it starts all processes again.

    They would find what those before them left: addresses that nobody answers at, and why they ended. Several torchruns
    count differently (pytorch/pytorch#135712), so that there the number says nothing.
    """
    number = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") if os.environ.get("GROUP_WORLD_SIZE") == "1" else "0"
    return f"attempt {number}"


def all_agree(store: dist.Store, rank: int, world: int, value: bool) -> bool:
    """Whether `value` is true in every process; before there is a group, through the store that they meet at."""
    store.set(f"agree/{rank}", str(value))
    return all(store.get(f"agree/{other}") == b"True" for other in range(world))


def label() -> str:
    """What a message of this process begins with: "rank 1 on <host>: ", or nothing where it is the only one."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return ""
    return f"rank {os.environ.get('RANK')} on {socket.gethostname()}: "


def weights_digest(method: Method) -> int:
    """A checksum of all networks and of torch's random state: what must be the same in all processes."""
    digest = zlib.crc32(torch.get_rng_state().numpy())
    for network in method.networks.values():
        for tensor in network.state_dict().values():
            digest = zlib.crc32(tensor.detach().cpu().contiguous().numpy().reshape(-1).view("uint8"), digest)
    return digest


class _Sum(torch.autograd.Function):
    """Every process's loss depends on the sum: the gradient of a summand is the sum of their gradients."""

    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        total = values.contiguous().clone()
        _all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        total = grad.contiguous().clone()
        _all_reduce(total)
        return total


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
        bucket = torch.cat([grad.reshape(-1) for grad in small])
        _all_reduce(bucket)
        for grad, total in zip(small, bucket.split([grad.numel() for grad in small]), strict=True):
            grad.copy_(total.view(grad.shape))


def _all_reduce(values: Tensor, op: Any = dist.ReduceOp.SUM) -> None:
    try:
        dist.all_reduce(values, op)
    except torch.cuda.OutOfMemoryError:
        raise
    except RuntimeError as error:  # a closed connection, or nobody answered in time
        raise LostPeerError(
            f"another process of the run failed, was killed or does not answer ({_first_sentence(error)})"
        ) from None


def _first_sentence(error: Exception) -> str:
    """What torch says, without the advice and the stack of calls that follow."""
    return str(error).strip().split("\n")[0].split(". ")[0]


def _announce(store: dist.Store, error: BaseException) -> bool:
    """Leave the reason to the others; whether another process of this machine has said the same already.

    A process that ends because of another one says which, and lets it end first: torchrun reports the first one to end,
    and ends all others at once.
    """
    mine, machine, said = f"{label()}{error or type(error).__name__}", os.environ.get("GROUP_RANK", "0"), False
    with contextlib.suppress(RuntimeError):  # the process that keeps the store is gone
        if isinstance(error, LostPeerError):
            if store.check(["failure"]):
                reason = store.get("failure").decode().partition("\n")[2]
                error.args = (f"ends because of another process: {reason}",)
        else:
            first = store.compare_set("failure", "", f"{machine}\n{mine}").decode()
            where, _, what = first.partition("\n")
            if what == mine:
                from torch.distributed.elastic.multiprocessing.errors import get_error_handler

                get_error_handler().record_exception(error)  # for torchrun's report
                return False
            if isinstance(error, Exception) and str(error) and what.endswith(str(error)):
                said = where == machine or store.compare_set(f"said on {machine}", "", mine).decode() != mine
    with contextlib.suppress(ValueError):  # not the main thread
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(LAST_WORDS)
    return said
