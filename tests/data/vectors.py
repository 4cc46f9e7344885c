"""Reads the reference vectors.

Those that hold third-party meshes are not part of the repository: they are tested where a folder with them is at hand
($NMR_VECTORS, or shared/vectors beside the checkout), and left out elsewhere.
"""

import json
import os
from pathlib import Path

import numpy as np
import torch

_FOLDERS = [
    Path(__file__).parent / "vectors",
    Path(
        os.environ.get("NMR_VECTORS") or Path(__file__).resolve().parents[3] / "shared" / "vectors"
    ),
]


def vector_names(pattern: str) -> list[str]:
    """Names (without .npz) of the vectors that match a pattern and are at hand."""
    return sorted({path.stem for folder in _FOLDERS for path in folder.glob(f"{pattern}.npz")})


def load_vector(name: str) -> dict[str, np.ndarray]:
    """All arrays of one vector file."""
    path = next(folder / f"{name}.npz" for folder in _FOLDERS if (folder / f"{name}.npz").exists())
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def gradient_tolerance(name: str) -> float:
    """Largest relative L2 difference that a gradient computed in another order of operations may show; inf if fragile.

    Five times what the reference itself shows with contracted multiply-adds or in float64, at least 1e-4.
    """
    folder = next(folder for folder in _FOLDERS if (folder / f"{name}.npz").exists())
    entry = json.loads((folder / "MANIFEST.json").read_text())[f"{name}.npz"]
    if entry["grad_fragile"]:
        return float("inf")
    return max(5 * max(entry["grad_l2rel_fma"], entry["grad_l2rel_f64"]), 1e-4)


def tensors_of(vector: dict[str, np.ndarray], prefix: str) -> dict[str, torch.Tensor]:
    """The numbers of a vector file whose names begin with a prefix, as tensors by the rest."""
    return {
        key.removeprefix(prefix): torch.from_numpy(value)
        for key, value in vector.items()
        if key.startswith(prefix) and value.dtype.kind != "U"
    }
