"""Where and at what precision networks run."""

from __future__ import annotations

from typing import Literal

import torch

CPUINFO = "/proc/cpuinfo"  # where Linux lists the instructions of the CPU


def resolve_precision(precision: Literal["auto", "bf16", "fp32"], device: str) -> Literal["bf16", "fp32"]:
    """Turn 'auto' into the faster arithmetic: bf16 on CUDA and on x86 CPUs with bf16 instructions, fp32 elsewhere.

    Measured on two cores with avx512_bf16: 334 ms per step for the networks in bf16 (channels last) and 676 ms in fp32.
    Without the instructions bf16 is emulated and slower than fp32.
    """
    if precision != "auto":
        return precision
    if device == "cuda":
        # By itself, is_bf16_supported() also says yes where bf16 is emulated.
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
