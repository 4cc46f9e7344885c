"""Untrusted pretrained weights: a function for the sandbox."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.reading import DamagedFile, check_file

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
    if not isinstance(weights, dict) or not all(isinstance(value, torch.Tensor) for value in weights.values()):
        raise DamagedFile(path, f"must hold a state dict (names -> tensors), got {type(weights).__name__}")
    halves = (torch.float16, torch.bfloat16)
    return {str(n): (t.float() if t.dtype in halves else t).detach().numpy() for n, t in weights.items()}
