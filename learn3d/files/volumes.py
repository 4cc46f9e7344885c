"""Voxel grids out of MATLAB's and binvox's files: functions for worker processes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from learn3d.files import limits
from learn3d.files.findings import FETCH_AGAIN, DamagedFile
from learn3d.files.reading import read_bytes

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15


def read_matlab(path: Path, name: str, size: int) -> np.ndarray:
    """The array `name` of numbers [size, size, size] of a MATLAB file (version 5 to 7) as bool: where it is not 0.

    scipy.io reads all that MATLAB writes, takes longer to import than ten objects take to read, and crashes for some
    damaged files.
    """
    wanted = f"a MATLAB file (version 5 to 7) with the array {name!r} [{size}, {size}, {size}]"
    content = memoryview(read_bytes(path, limits.VOLUME_BYTES, wanted))
    order = {b"IM": "<", b"MI": ">"}.get(bytes(content[126:128]))
    if order is None:
        raise DamagedFile(path, f"cannot be read: it has no header of MATLAB; expected {wanted}. {FETCH_AGAIN}")
    for kind, element in _elements(content[128:], order):
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(element, limits.SMALL_BYTES)
            kind, element = next(_elements(memoryview(unpacked), order), (0, b""))
        if kind == _MATRIX:
            flags, shape, found, *values = list(_elements(element, order))[:4]
            if bytes(found[1]) == name.encode():
                break
    else:
        raise DamagedFile(path, f"has no such array; expected {wanted}")
    kind, is_complex = (bits := np.frombuffer(flags[1], order + "u4")[0]) & 0xFF, bits & 0x800
    numeric = 6 <= kind <= 15 and not is_complex  # from double to uint64
    shape = np.frombuffer(shape[1], order + "i4").tolist()
    if not numeric or shape != [size] * 3 or not values or values[0][0] not in _TYPES:
        raise DamagedFile(path, f"has {'numbers' if numeric else 'no numbers'} {shape}; expected {wanted}")
    array = np.frombuffer(values[0][1], order + _TYPES[values[0][0]])
    return array.reshape(shape, order="F") != 0


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and content of each element of a MATLAB file: eight bytes that tell them, and as many bytes as they say."""
    while len(content) >= 8:
        kind, size = struct.unpack(order + "II", content[:8])
        start = 8
        if kind >> 16:  # up to four bytes lie within the eight
            kind, size, start = kind & 0xFFFF, kind >> 16, 4
        if size > len(content) - start:
            raise ValueError("it ends early")
        yield kind, content[start : start + size]
        content = content[start + size if kind == _COMPRESSED else max(8, start + size + -size % 8) :]


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
