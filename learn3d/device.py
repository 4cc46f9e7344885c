"""Device and precision of the networks, and memory allocation."""

import ctypes
from pathlib import Path
from typing import Literal

import torch

CPUINFO = "/proc/cpuinfo"  # Linux lists the CPU's instruction sets here


def resolve_precision(
    precision: Literal["auto", "bf16", "fp32"], device: str
) -> Literal["bf16", "fp32"]:
    """Turn 'auto' into the faster precision: bf16 on CUDA and on x86 CPUs with bf16 instructions, else fp32.

    bf16 instructions halve the time of the networks; without them bf16 is emulated and slower
    than fp32.
    """
    if precision != "auto":
        return precision
    if device == "cuda":
        return "bf16" if torch.cuda.is_bf16_supported(including_emulation=False) else "fp32"
    flags = Path(CPUINFO).read_text() if Path(CPUINFO).exists() else ""
    return "bf16" if "avx512_bf16" in flags or "amx_bf16" in flags else "fp32"


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
