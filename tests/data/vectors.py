"""Reads the reference vectors.

Those that hold third-party meshes are not part of the repository: they are tested where a folder with them is at hand
($NMR_VECTORS, or shared/vectors beside the checkout), and left out elsewhere.
"""

import os
from pathlib import Path

import numpy as np

_FOLDERS = [
    Path(__file__).parent / "vectors",
    Path(os.environ.get("NMR_VECTORS") or Path(__file__).resolve().parents[3] / "shared" / "vectors"),
]


def vector_names(pattern: str) -> list[str]:
    """Names (without .npz) of the vectors that match a pattern and are at hand."""
    return sorted({path.stem for folder in _FOLDERS for path in folder.glob(f"{pattern}.npz")})


def load_vector(name: str) -> dict[str, np.ndarray]:
    """All arrays of one vector file."""
    path = next(folder / f"{name}.npz" for folder in _FOLDERS if (folder / f"{name}.npz").exists())
    with np.load(path, allow_pickle=False) as file:
        return dict(file)
