"""How the processes that torchrun started find each other, and how they end together when one of them fails."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from datetime import timedelta

import torch
import torch.distributed as dist

# A module imported later would keep a reference to the process group of that moment, whose threads then never end.
import torch.distributed.nn.functional
from torch.distributed.elastic.multiprocessing.errors import get_error_handler
from torch.distributed.rendezvous import rendezvous

from learn3d.device import check_device
from learn3d.distributed.process_group import SINGLE_PROCESS, LostPeerError, ProcessGroup, first_sentence
from learn3d.terminal import rank_label

TIMEOUT = timedelta(minutes=10)  # how long a process waits for the others before it gives up
GRACE_SECONDS = 2.0  # how long a failing process waits before it ends, so that the one with the first error ends first


@contextlib.contextmanager
def init_process_group(device: str) -> Iterator[ProcessGroup]:
    """This process among those that torchrun started, or `SINGLE_PROCESS` without torchrun.

    With the device cuda each process of a machine takes its own GPU, and NCCL sums there. If a machine has more
    processes than GPUs they share them, and all sum over gloo. If the body raises, the other processes learn why.
    """
    world_size = int(os.environ.get("WORLD_SIZE", "1"))
    if world_size == 1:
        yield SINGLE_PROCESS
        return
    if missing := [name for name in ("RANK", "MASTER_ADDR", "MASTER_PORT") if name not in os.environ]:
        raise ValueError(
            f"WORLD_SIZE is {world_size}, but {', '.join(missing)} is not set; start the processes by torchrun"
        )
    rank, local_world_size = int(os.environ["RANK"]), int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    check_device(device)
    own_gpu = False
    if device == "cuda":
        gpus = torch.cuda.device_count()
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % gpus)
        own_gpu = local_world_size <= gpus
    try:
        store, _, _ = next(rendezvous("env://", rank, world_size, timeout=TIMEOUT))
        store = dist.PrefixStore(_attempt(), store)
        backend = "cpu:gloo,cuda:nccl" if all_true(store, rank, world_size, own_gpu) else "gloo"
        group_store = dist.PrefixStore("run", store)
        dist.init_process_group(backend, store=group_store, rank=rank, world_size=world_size, timeout=TIMEOUT)
    except RuntimeError as error:
        raise LostPeerError(
            f"the {world_size} processes of the run did not find each other by {os.environ['MASTER_ADDR']}:"
            f"{os.environ['MASTER_PORT']} ({first_sentence(error)}); one of them has ended before (it says why), or "
            "the machines do not reach each other (docs/multi-process.md)"
        ) from None
    try:
        yield ProcessGroup(
            rank, world_size, local_world_size=local_world_size, backend="gloo" if backend == "gloo" else "NCCL"
        )
    except BaseException as error:
        was_printed = _announce(store, error)
        # To close NCCL's group, or one whose sum was interrupted, may wait for the other processes for ever.
        if backend == "gloo" and isinstance(error, Exception):
            dist.destroy_process_group()
        if was_printed:
            raise SystemExit(1) from None
        raise
    dist.destroy_process_group()


def all_true(store: dist.Store, rank: int, world_size: int, value: bool) -> bool:
    """Whether `value` is true in every process, by the store: there is no process group yet."""
    store.set(f"value/{rank}", str(value))
    return all(store.get(f"value/{other}") == b"True" for other in range(world_size))


def _attempt() -> str:
    """A name in the store for this attempt. torchrun keeps the store when it starts all processes again.

    Without it they would find the addresses and the error of the processes that have ended. Several torchruns count
    attempts differently (pytorch/pytorch#135712), so the count is used for a single one only.
    """
    number = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") if os.environ.get("GROUP_WORLD_SIZE") == "1" else "0"
    return f"attempt {number}"


def _announce(store: dist.Store, error: BaseException) -> bool:
    """Tell the other processes why this one ends. True if another process of this machine prints the same error.

    A process that ends because of another one names that one's error and waits a moment: torchrun reports the first
    process that ends and then ends all the others.
    """
    mine, machine = f"{rank_label()}{error or type(error).__name__}", os.environ.get("GROUP_RANK", "0")
    was_printed = False
    with contextlib.suppress(RuntimeError):  # the process that keeps the store is gone
        if isinstance(error, LostPeerError):
            if store.check(["failure"]):
                reason = store.get("failure").decode().partition("\n")[2]
                error.args = (f"ends because of another process: {reason}",)
        else:
            failed_on, _, first = store.compare_set("failure", "", f"{machine}\n{mine}").decode().partition("\n")
            if first == mine:
                get_error_handler().record_exception(error)  # for torchrun's report
                return False
            if isinstance(error, Exception) and str(error) and first.endswith(str(error)):
                printed = f"printed on {machine}"
                was_printed = failed_on == machine or store.compare_set(printed, "", mine).decode() != mine
    with contextlib.suppress(ValueError):  # not the main thread
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(GRACE_SECONDS)
    return was_printed
