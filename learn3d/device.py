"""Device and precision of the networks, and memory allocation."""

import ctypes
from pathlib import Path
from typing import Literal

import torch

CPUINFO = "/proc/cpuinfo"  # Linux lists the CPU's instruction sets here


def resolve_precision(
    precision: Literal["auto", "bf16", "fp32"], device: str
) -> Literal["bf16", "fp32"]:
    """Turn 'auto' into the faster precision: bf16 on CUDA and CPUs with fast bf16, else fp32.

    Fast are AMX, and AVX-512's on AMD's processors: they halve the time of the networks. With
    Intel's AVX-512 instructions alone bf16 takes 1.2 times the time of fp32; without any it is
    emulated.
    """
    if precision != "auto":
        return precision
    if device == "cuda":
        return "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "fp32"
    cpu = Path(CPUINFO).read_text() if Path(CPUINFO).exists() else ""
    fast = "amx_bf16" in cpu or ("AuthenticAMD" in cpu and "avx512_bf16" in cpu)
    return "bf16" if fast else "fp32"


_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4  # <malloc.h>


def keep_freed_memory() -> bool:
    """Let this process reuse freed memory instead of returning it; True if that worked (Linux with glibc).

    By default each step maps and unmaps the pages of every large tensor, a quarter of its CPU
    time at batch 128. Resident memory stays at its peak.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # another C library
        return False
    return all(
        (
            mallopt(_M_MMAP_MAX, 0),
            mallopt(_M_TRIM_THRESHOLD, 2**31 - 1),
            mallopt(_M_TOP_PAD, 1 << 27),
        )
    )
