"""An array of numbers out of a MATLAB file (version 5 to 7), found here and decoded by scipy.

scipy follows whatever a file holds: cells within cells until the stack overflows, and sizes of gigabytes. So the file
is searched here, element by element, for the one array that is wanted, and scipy sees nothing but that.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy.io

from learn3d.files import limits
from learn3d.files.findings import AGAIN, DamagedFile
from learn3d.files.reading import read_bytes

_MATRIX, _COMPRESSED = 14, 15  # types of elements
_NUMERIC = range(6, 16)  # classes of matrices: double, single, and whole numbers of 8 to 64 bits


def read_matlab(path: Path, name: str, wanted: str) -> np.ndarray | None:
    """The array `name`, None where the file has none of numbers. Raises DamagedFile and MissingFile.

    Files up to 4 MiB are read, and as much may the array take once it is unpacked.
    """
    content = read_bytes(path, limits.VOLUME_BYTES, wanted)
    try:
        for element in _matrices(content):
            if _is_numeric(element, name, _order(content)):
                found = scipy.io.loadmat(io.BytesIO(content[:128] + element), variable_names=[name])[name]
                return found if isinstance(found, np.ndarray) and found.dtype.kind in "buif" else None
    except Exception as error:  # scipy's parser raises whatever a damaged file leads it to
        raise DamagedFile(path, f"cannot be read ({error}); expected {wanted}. {AGAIN}") from error
    return None


def _order(content: bytes) -> str:
    if len(content) < 128 or content[126:128] not in (b"IM", b"MI"):
        raise ValueError("it is no MATLAB file of version 5 to 7")
    return "<" if content[126:128] == b"IM" else ">"


def _matrices(content: bytes) -> Iterator[bytes]:
    """The matrix elements of a file with their tags, unpacked."""
    order, at = _order(content), 128
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        element = content[at : at + 8 + size]
        if len(element) < 8 + size:
            raise ValueError("it ends early")
        at += 8 + size
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            element = unpacker.decompress(element[8:], limits.VOLUME_BYTES)
            if not unpacker.eof:
                raise ValueError(f"an array is cut short, or unpacks to more than {limits.VOLUME_BYTES} bytes")
            kind, size = struct.unpack_from(f"{order}II", element)
            if 8 + size != len(element):
                raise ValueError(f"an array of {len(element) - 8} bytes says it has {size}")
        if kind == _MATRIX:
            yield element


def _is_numeric(element: bytes, name: str, order: str) -> bool:
    """Whether a matrix element is the array `name` of numbers; ValueError where its sizes cannot be."""
    _, _, kind, length, flags = struct.unpack_from(f"{order}IIIII", element)
    if kind != 6 or length != 8:
        raise ValueError("an array has no flags")
    kind, length = struct.unpack_from(f"{order}II", element, 24)
    if kind != 5 or not 0 < length <= 4 * 32 or length % 4:
        raise ValueError("an array has no dimensions")
    dims = struct.unpack_from(f"{order}{length // 4}i", element, 32)
    at = 32 + length + length % 8
    kind, length = struct.unpack_from(f"{order}II", element, at)
    if kind >> 16:  # a short name lies in the tag itself
        length, at = kind >> 16, at + 4
    else:
        at += 8
    found = element[at : at + length].decode("latin-1")
    total = 1
    for size in dims:
        total *= size
        if size < 0 or total > limits.VOLUME_BYTES:
            raise ValueError(f"the array {found[:40]!r} has the size {list(dims)}")
    return found == name and flags & 0xFF in _NUMERIC
