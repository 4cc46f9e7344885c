"""Reads the reference vectors: those of tests/data/vectors, and third-party meshes from ../shared where that exists."""

from pathlib import Path

import numpy as np

_FOLDERS = [
    Path(__file__).parent / "vectors",
    Path(__file__).resolve().parents[3] / "shared" / "vectors",
]


def vector_names(pattern: str) -> list[str]:
    """Names (without .npz) of the vectors that match a pattern and are at hand."""
    return sorted({path.stem for folder in _FOLDERS for path in folder.glob(f"{pattern}.npz")})


def load_vector(name: str) -> dict[str, np.ndarray]:
    """All arrays of one vector file."""
    path = next(folder / f"{name}.npz" for folder in _FOLDERS if (folder / f"{name}.npz").exists())
    with np.load(path, allow_pickle=False) as file:
        return dict(file)
