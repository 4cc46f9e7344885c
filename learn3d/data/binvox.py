"""Voxel grids in the binvox format: a text header, then runs of (value, count) bytes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from learn3d.data.findings import AGAIN, DamagedFile, MissingFile

_WANTED = "a binvox file: '#binvox 1', the lines dim, translate, scale and data, then pairs of bytes"


class Binvox(NamedTuple):
    """One grid: cell (i, j, k) has its centre at translate + scale * ((i, j, k) + 0.5) / size of the mesh's x, y, z."""

    voxels: np.ndarray  # bool [D, D, D], axes x, y, z of the mesh
    translate: np.ndarray  # float64 [3], corner of the grid
    scale: float  # side of the grid


def read_binvox(path: Path, size: int) -> Binvox:
    """Read a grid of size^3 cells. The file keeps y fastest, then z, then x. Raises DamagedFile, MissingFile."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise MissingFile(path, "is missing; expected a voxel grid in the binvox format") from None
    except OSError as error:
        raise DamagedFile(path, f"cannot be read ({error}). {AGAIN}") from error
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
    if translate.shape != (3,) or not np.isfinite(translate).all() or not (np.isfinite(scale) and scale > 0):
        raise DamagedFile(path, f"has translate {translate} and scale {scale}; expected three numbers and one above 0")
    pairs = np.frombuffer(runs[: len(runs) // 2 * 2], np.uint8).reshape(-1, 2)
    total = int(pairs[:, 1].sum(dtype=np.int64))
    if total != size**3:
        raise DamagedFile(path, f"its runs fill {total} cells; expected {size**3}. {AGAIN}")
    grid = np.repeat(pairs[:, 0] != 0, pairs[:, 1]).reshape(size, size, size)  # axes x, z, y
    return Binvox(np.ascontiguousarray(grid.transpose(0, 2, 1)), translate, scale)
