"""How the processes that torchrun started find each other, and how they end when one of them fails."""

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

from learn3d.device import check_device
from learn3d.distributed.process_group import SINGLE_PROCESS, LostPeerError, ProcessGroup, first_sentence

TIMEOUT = timedelta(minutes=10)  # how long a process waits for the others before it gives up
GRACE_SECONDS = 2.0  # how long a process that lost another one waits, so that torchrun sees the other one end first


@contextlib.contextmanager
def init_process_group(device: str) -> Iterator[ProcessGroup]:
    """This process among those that torchrun started, or `SINGLE_PROCESS` without torchrun.

    With the device cuda each process of a machine takes its own GPU, and NCCL sums there. If this machine has more
    processes than GPUs they share them, and all sum over gloo. Raises LostPeerError if the processes do not find each
    other.
    """
    world_size = int(os.environ.get("WORLD_SIZE", "1"))
    if world_size == 1:
        yield SINGLE_PROCESS
        return
    check_device(device)
    backend, local_world_size = "gloo", int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if device == "cuda":
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
        if local_world_size <= torch.cuda.device_count():
            backend = "cpu:gloo,cuda:nccl"
    try:
        store, rank, _ = next(dist.rendezvous("env://", timeout=TIMEOUT))
        # torchrun keeps the store when it starts all processes again: without a name of their own for this attempt,
        # they would find the addresses of those that ended. Several torchruns count attempts differently
        # (pytorch/pytorch#135712), so the count is used for a single one only.
        attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT") if os.environ.get("GROUP_WORLD_SIZE") == "1" else None
        store = dist.PrefixStore(f"attempt {attempt}", store)
        dist.init_process_group(backend, store=store, rank=rank, world_size=world_size, timeout=TIMEOUT)
    except RuntimeError as error:
        raise LostPeerError(
            f"the {world_size} processes of the run did not find each other by {os.environ['MASTER_ADDR']}:"
            f"{os.environ['MASTER_PORT']} ({first_sentence(error)}); one of them has ended before (it says why), or "
            "the machines do not reach each other (docs/multi-process.md)"
        ) from None
    try:
        name = "gloo" if backend == "gloo" else "NCCL"
        yield ProcessGroup(dist.get_rank(), world_size, local_world_size=local_world_size, backend=name)
    except BaseException as error:
        if isinstance(error, LostPeerError):
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # torchrun ends all processes, and this one has to say why
            time.sleep(GRACE_SECONDS)
        else:
            get_error_handler().record_exception(error)  # for torchrun's report
        # To close NCCL's group, or one whose sum was interrupted, may wait for the other processes for ever.
        if backend == "gloo" and isinstance(error, Exception):
            dist.destroy_process_group()
        raise
    dist.destroy_process_group()
