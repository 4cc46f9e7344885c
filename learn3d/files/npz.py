"""Reads arrays of untrusted npz files in the sandbox, straight into shared memory.

NumPy stores object arrays, for example images of different sizes, as pickles. Here a pickle can only call the functions
that make NumPy arrays, so it cannot run other code.
"""

from __future__ import annotations

import functools
import math
import os
import pickle
import warnings
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.reading import open_file

_BYTES_PER_SECOND = 3e7  # a tenth of the speed of decompression


def keys(path: Path) -> list[str]:
    """Names of the arrays of an npz file."""
    return [name.removesuffix(".npy") for name in _archive(path).namelist()]


def read(path: Path, key: str, max_bytes: int | None = None) -> np.ndarray:
    """The array `key`, of numbers or bools. Raises ValueError for other arrays and larger ones.

    max_bytes: largest size; None if unknown, then large arrays with a suspicious compression ratio are refused.
    """
    info = _member(path, key, max_bytes)
    with _archive(path).open(info) as file:
        shape, fortran, dtype = _header(file)
        count, there = math.prod(shape), info.file_size - file.tell()
        if dtype.kind not in "biuf" or count * dtype.itemsize != there:
            raise ValueError(f"{key!r} must be numbers that take {there} bytes, got {dtype} {shape}")
        sandbox.allow(seconds=there / _BYTES_PER_SECOND)
        array, at = sandbox.empty((count,), dtype), 0
        content = array.view(np.uint8)
        while piece := file.read(2**20):  # zipfile compares the checksum at the end
            content[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
            at += len(piece)
    if dtype.kind == "b" and content.max(initial=0) > 1:  # NumPy and torch compute wrong results with them
        raise ValueError(f"the bools of {key!r} have values other than 0 and 1")
    return array.reshape(shape, order="F" if fortran else "C")


def read_existing(path: Path, names: Iterable[str], max_bytes: int) -> dict[str, np.ndarray]:
    """The arrays among `names` that the file has, each of at most `max_bytes` bytes."""
    existing = set(keys(path))
    return {name: read(path, name, max_bytes) for name in names if name in existing}


def read_table(path: Path, names: list[str]) -> dict[str, np.ndarray]:
    """All arrays of a file. Raises ValueError if their names are not `names`."""
    if sorted(existing := keys(path)) != sorted(names):
        raise ValueError(f"has the arrays {', '.join(existing)[:200]}; expected {', '.join(names)}")
    return {name: read(path, name) for name in names}


def read_with_items(path: Path, key: str, others: dict[str, int]) -> list[Any]:
    """`read_ragged` of the array `key`, then arrays with as many items. others: name -> largest bytes of an item."""
    first = read_ragged(path, key)
    count = len(first[1] if isinstance(first, tuple) else first)
    return [first, *(read(path, name, count * size) for name, size in others.items())]


def read_ragged(path: Path, key: str) -> np.ndarray | tuple[np.ndarray, list[tuple[int, ...]]]:
    """An array of numbers; or, of an object array of uint8 arrays, all their bytes concatenated, and their shapes."""
    info = _member(path, key)
    with _archive(path).open(info) as file:
        if not _header(file)[2].hasobject:
            return read(path, key)
        sandbox.allow(3 * info.file_size, 2 * info.file_size / _BYTES_PER_SECOND)
        items = _Arrays(file, encoding="bytes").load()
    if type(items) is not np.ndarray or items.dtype != object or items.ndim != 1:
        raise ValueError(f"{key!r} must be a list of arrays")
    for k, item in enumerate(items):
        if type(item) is not np.ndarray or item.dtype != np.uint8:
            raise ValueError(f"{key}[{k}] must be an array of uint8, got {getattr(item, 'dtype', type(item).__name__)}")
    size = sum(item.nbytes for item in items)
    if size > info.file_size:  # the pickle refers to the same array many times
        raise ValueError(f"the arrays of {key!r} take more bytes than the file has")
    flat = sandbox.empty((size,), np.uint8)
    np.concatenate([np.empty(0, np.uint8), *(item.reshape(-1) for item in items)], out=flat)
    return flat, [item.shape for item in items]


def _make_array(kind: type, shape: Any, code: Any) -> np.ndarray:
    return np.empty(0, np.uint8)  # the pickle sets its state later


_ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _make_array,
    ("numpy._core.multiarray", "_reconstruct"): _make_array,
    ("_codecs", "encode"): lambda text, _: text.encode("latin-1"),  # for bytes in protocol 2
}


class _Arrays(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise ValueError(f"its pickle calls {module}.{name}, which no array needs; nothing was run")
        return _ALLOWED[module, name]


def _archive(path: Path) -> zipfile.ZipFile:
    status = os.stat(path)
    return _open(path, status.st_ino, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=1)  # a mesh pack is read array by array; its file status is the key for changes
def _open(path: Path, *_: int) -> zipfile.ZipFile:
    return zipfile.ZipFile(open_file(path, limits.ARRAY_BYTES, "an npz file"))


def _member(path: Path, key: str, max_bytes: int | None = None) -> zipfile.ZipInfo:
    """The npy file of the array `key`. Raises ValueError if its unpacked size exceeds the limit."""
    info = _archive(path).getinfo(f"{key}.npy")
    if max_bytes is None:
        max_bytes = min(limits.ARRAY_BYTES, max(limits.SMALL_BYTES, limits.EXPANSION * info.compress_size))
    if info.file_size > max_bytes + 1000:  # the header has 128 bytes
        times = info.file_size / max(1, info.compress_size)
        found = f"would unpack to {info.file_size} bytes, {times:.0f} times its size"
        raise ValueError(f"{key!r} {found}; the limit is {max_bytes}")
    return info


def _header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, Fortran order and dtype from the header of an npy file."""
    if (version := np.lib.format.read_magic(file)) != (1, 0):  # other versions are for large or non-ASCII headers
        raise ValueError(f"npy format {version[0]}.{version[1]} is not supported, only 1.0")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Reading `.npy`")  # Python 2's headers have numbers such as 12L
        return np.lib.format.read_array_header_1_0(file)
