"""The device and the precision of the networks, and the memory of a step."""

from __future__ import annotations

import ctypes
from typing import Literal

import torch
from torch import Tensor

CPUINFO = "/proc/cpuinfo"  # Linux lists the instructions of the CPU in it


def resolve_precision(precision: Literal["auto", "bf16", "fp32"], device: str) -> Literal["bf16", "fp32"]:
    """Turn 'auto' into the faster arithmetic: bf16 on CUDA and on x86 CPUs with bf16 instructions, fp32 elsewhere.

    With the instructions a step of the networks takes half the time; without them bf16 is emulated, and slower.
    """
    if precision != "auto":
        return precision
    if device == "cuda":
        return "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "fp32"
    try:
        with open(CPUINFO) as file:
            flags = next((line.split(":", 1)[1].split() for line in file if line.startswith("flags")), [])
    except OSError:
        flags = []
    return "bf16" if {"avx512_bf16", "amx_bf16"} & set(flags) else "fp32"


def autocast(device: torch.device | str, precision: Literal["bf16", "fp32"]) -> torch.autocast:
    """Context in which the networks run at the given precision; losses and rendering belong outside it."""
    return torch.autocast(torch.device(device).type, dtype=torch.bfloat16, enabled=precision == "bf16")


def check_device(device: str) -> None:
    """Raise a ValueError when CUDA is asked for and absent."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device 'cuda' was asked for, but this PyTorch sees no CUDA device; use device 'cpu'")


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """Queue the copy of a tensor on the CPU to `device`; on the CPU the tensor itself. Gradients go to the original."""
    return tensor.to(device, non_blocking=True)


_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4  # <malloc.h>


def keep_freed_memory() -> bool:
    """Let this process reuse freed memory instead of returning it; True if that could be set (Linux with glibc).

    Every large tensor is otherwise mapped, page by page, and unmapped again in each step: a quarter of the step's CPU
    time at batch 128 (LOG.md). Resident memory stays at its peak.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # another C library
        return False
    return all((mallopt(_M_MMAP_MAX, 0), mallopt(_M_TRIM_THRESHOLD, 2**31 - 1), mallopt(_M_TOP_PAD, 1 << 27)))
