"""Voxel grids in the binvox format: a text header, then runs of (value, count) bytes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from learn3d.files import limits
from learn3d.files.findings import AGAIN, DamagedFile
from learn3d.files.reading import read_bytes

_WANTED = "a binvox file: '#binvox 1', the lines dim, translate, scale and data, then pairs of bytes"


class Binvox(NamedTuple):
    """One grid: cell (i, j, k) has its centre at translate + scale * ((i, j, k) + 0.5) / size of the mesh's x, y, z."""

    voxels: np.ndarray  # bool [D, D, D], axes x, y, z of the mesh
    translate: np.ndarray  # float64 [3], corner of the grid
    scale: float  # side of the grid


def read_binvox(path: Path, size: int) -> Binvox:
    """Read a grid of size^3 cells. The file keeps y fastest, then z, then x. Raises DamagedFile, MissingFile."""
    content = read_bytes(path, limits.VOLUME_BYTES, "a voxel grid in the binvox format")
    head, found, runs = content.partition(b"\ndata\n")
    lines = [line.split() for line in head.split(b"\n")]
    header = {line[0]: line[1:] for line in lines if line}
    try:
        dim = [int(word) for word in header[b"dim"]]
        translate = np.array([float(word) for word in header[b"translate"]])
        (scale,) = (float(word) for word in header[b"scale"])
    except (KeyError, ValueError):
        found = b""
    if not found or not content.startswith(b"#binvox"):
        raise DamagedFile(path, f"has no such header; expected {_WANTED}. {AGAIN}")
    if dim != [size] * 3:
        raise DamagedFile(path, f"holds {'x'.join(map(str, dim))} cells; expected {size}x{size}x{size}")
    low, high = limits.DISTANCE
    if translate.shape != (3,) or not (np.abs(translate) <= high).all() or not low <= scale <= high:
        raise DamagedFile(
            path, f"has translate {translate} and scale {scale}; expected three numbers and one of {low:g} .. {high:g}"
        )
    pairs = np.frombuffer(runs[: len(runs) // 2 * 2], np.uint8).reshape(-1, 2)
    total = int(pairs[:, 1].sum(dtype=np.int64))
    if total != size**3:
        raise DamagedFile(path, f"its runs fill {total} cells; expected {size**3}. {AGAIN}")
    grid = np.repeat(pairs[:, 0] != 0, pairs[:, 1]).reshape(size, size, size)  # axes x, z, y
    return Binvox(np.ascontiguousarray(grid.transpose(0, 2, 1)), translate, scale)
