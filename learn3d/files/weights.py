"""Untrusted pretrained weights: a function for the sandbox."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.findings import DamagedFile
from learn3d.files.reading import check_file

MEMORY = 2**30  # bytes that importing torch may add, beside four times the file's size
SECONDS = 30.0


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """The tensors of a state dict (.safetensors or from torch.save), floating-point ones as float32 or float64.

    Nothing in the file is executed (weights_only). Raises DamagedFile if it is no state dict of plain numbers.
    """
    import torch
    from safetensors.torch import load_file

    sandbox.allow(4 * check_file(path, limits.WEIGHTS_BYTES, "weights of ResNet-18"))
    is_torch = path.suffix != ".safetensors"
    weights = torch.load(path, map_location="cpu", weights_only=True) if is_torch else load_file(path)
    kinds = {(str, torch.Tensor)}
    if not isinstance(weights, dict) or not {(type(name), type(value)) for name, value in weights.items()} <= kinds:
        raise DamagedFile(path, f"must hold a state dict (names -> tensors), got {type(weights).__name__}")
    arrays = {}
    for name, value in weights.items():
        real = value.dtype in (torch.float32, torch.float64, torch.float16, torch.bfloat16)
        if not (real or value.dtype in (torch.int64, torch.int32)) or value.layout != torch.strided or value.is_meta:
            kind = f"{value.dtype}, {value.layout}, on {value.device}"
            raise DamagedFile(path, f"{name} must be plain numbers such as torch.float32, got {kind}")
        arrays[name] = (value.float() if real and value.dtype != torch.float64 else value).detach().numpy()
    return arrays
