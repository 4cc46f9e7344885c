"""Voxel grids out of MATLAB's and binvox's files: functions for the sandbox."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from learn3d.files import limits
from learn3d.files.findings import FETCH_AGAIN, DamagedFile
from learn3d.files.reading import open_file, read_bytes


def read_matlab(path: Path, name: str, size: int) -> np.ndarray:
    """The array `name` of numbers [size, size, size] of a MATLAB file (version 5 to 7) as bool: True if not 0."""
    import scipy.io  # here, as it takes longer to import than all else in a worker

    wanted = f"a MATLAB file (version 5 to 7) with the array {name!r} of numbers [{size}, {size}, {size}]"
    with open_file(path, limits.VOLUME_BYTES, wanted) as file:
        array = np.asarray(scipy.io.loadmat(file, variable_names=[name]).get(name))
    if array.dtype.kind not in "biuf" or array.shape != (size,) * 3:
        raise DamagedFile(path, f"has {array.dtype} {list(array.shape)} there; expected {wanted}")
    return array != 0


class Binvox(NamedTuple):
    """One grid: cell (i, j, k) has its centre at translate + scale * ((i, j, k) + 0.5) / size of the mesh's x, y, z."""

    voxels: np.ndarray  # bool [D, D, D], axes x, y, z of the mesh
    translate: np.ndarray  # float64 [3], corner of the grid
    scale: float  # side of the grid


def read_binvox(path: Path, size: int) -> Binvox:
    """A grid of size^3 cells: a text header, then runs of (value, count) bytes with y fastest, then z, then x."""
    wanted = f"a binvox file of {size}x{size}x{size} cells: the lines dim, translate, scale, data, then pairs of bytes"
    head, _, runs = read_bytes(path, limits.VOLUME_BYTES, wanted).partition(b"\ndata\n")
    header = {words[0]: words[1:] for line in head.split(b"\n") if (words := line.split())}
    try:
        translate, (scale,) = np.array(header[b"translate"], np.float64), np.array(header[b"scale"], np.float64)
        if header[b"dim"] != [b"%d" % size] * 3 or translate.shape != (3,):
            raise ValueError
    except (KeyError, ValueError):
        raise DamagedFile(path, f"has another header; expected {wanted}") from None
    low, high = limits.DISTANCE
    if not (np.abs(translate) <= high).all() or not low <= scale <= high:
        raise DamagedFile(path, f"has translate {translate} and scale {scale}; expected {low:g} .. {high:g}")
    pairs = np.frombuffer(runs[: len(runs) // 2 * 2], np.uint8).reshape(-1, 2)
    if (total := int(pairs[:, 1].sum(dtype=np.int64))) != size**3:
        raise DamagedFile(path, f"its runs fill {total} cells; expected {size**3}. {FETCH_AGAIN}")
    grid = np.repeat(pairs[:, 0] != 0, pairs[:, 1]).reshape(size, size, size)  # axes x, z, y
    return Binvox(np.ascontiguousarray(grid.transpose(0, 2, 1)), translate, float(scale))
