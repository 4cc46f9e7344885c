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

    wanted = f"a MATLAB file (version 5 to 7) with the array {name!r} [{size}, {size}, {size}]"
    with open_file(path, limits.VOLUME_BYTES, wanted) as file:
        array = scipy.io.loadmat(file, variable_names=[name]).get(name)
    if not isinstance(array, np.ndarray):
        raise DamagedFile(path, f"has no such array; expected {wanted}")
    kind = "numbers" if array.dtype.kind in "biuf" else "no numbers"
    if kind == "no numbers" or array.shape != (size,) * 3:
        raise DamagedFile(path, f"has {kind} {list(array.shape)}; expected {wanted}")
    return array != 0


class Binvox(NamedTuple):
    """One grid: cell (i, j, k) has its centre at translate + scale * ((i, j, k) + 0.5) / size of the mesh's x, y, z."""

    voxels: np.ndarray  # bool [D, D, D], axes x, y, z of the mesh
    translate: np.ndarray  # float64 [3], corner of the grid
    scale: float  # side of the grid


def read_binvox(path: Path, size: int) -> Binvox:
    """A grid of size^3 cells: a text header, then runs of (value, count) bytes with y fastest, then z, then x."""
    wanted = "a binvox file: '#binvox 1', the lines dim, translate, scale and data, then pairs of bytes"
    content = read_bytes(path, limits.VOLUME_BYTES, wanted)
    head, found, runs = content.partition(b"\ndata\n")
    header = {line.split()[0]: line.split()[1:] for line in head.split(b"\n") if line.strip()}
    try:
        dim = [int(word) for word in header[b"dim"]]
        translate = np.array([float(word) for word in header[b"translate"]])
        (scale,) = (float(word) for word in header[b"scale"])
    except (KeyError, ValueError):
        found = b""
    if not found or not content.startswith(b"#binvox"):
        raise DamagedFile(path, f"has no such header; expected {wanted}. {FETCH_AGAIN}")
    if dim != [size] * 3:
        raise DamagedFile(path, f"holds {'x'.join(map(str, dim))} cells; expected {size}x{size}x{size}")
    low, high = limits.DISTANCE
    if translate.shape != (3,) or not (np.abs(translate) <= high).all() or not low <= scale <= high:
        raise DamagedFile(path, f"has translate {translate} and scale {scale}; expected {low:g} .. {high:g}")
    pairs = np.frombuffer(runs[: len(runs) // 2 * 2], np.uint8).reshape(-1, 2)
    if (total := int(pairs[:, 1].sum(dtype=np.int64))) != size**3:
        raise DamagedFile(path, f"its runs fill {total} cells; expected {size**3}. {FETCH_AGAIN}")
    grid = np.repeat(pairs[:, 0] != 0, pairs[:, 1]).reshape(size, size, size)  # axes x, z, y
    return Binvox(np.ascontiguousarray(grid.transpose(0, 2, 1)), translate, scale)
