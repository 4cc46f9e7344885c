"""Reads untrusted pretrained weights in the sandbox."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.reading import DamagedFile, check_file

MEMORY = 2**30  # bytes for importing torch; `read_state_dict` adds four times the file's size
SECONDS = 30.0  # processor time


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Read the tensors of a state dict (.safetensors or from torch.save); half precision becomes float32.

    No code in the file is executed (weights_only). Raises DamagedFile if it is not a state dict.
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
