"""Reads arrays of untrusted npz files in the sandbox, straight into shared memory.

NumPy stores object arrays, for example images of different sizes, as pickles. Here a pickle can only call the functions
that make NumPy arrays, so it cannot run other code.
"""

import functools
import math
import os
import pickle
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.reading import open_file

_BYTES_PER_SECOND = 3e7  # a tenth of the speed of decompression


def names(path: Path) -> list[str]:
    """Names of the arrays of an npz file."""
    return [name.removesuffix(".npy") for name in _archive(path).namelist()]


def read(path: Path, key: str, max_bytes: int | None = None) -> np.ndarray:
    """The array `key`, of numbers or bools. Raises ValueError for other arrays and larger ones.

    max_bytes: largest size; None if unknown, then large arrays with a suspicious compression ratio are refused.
    """
    file, size = _open(path, key, max_bytes)
    shape, fortran, dtype = _header(file)
    count, there = math.prod(shape), size - file.tell()
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


def read_several(path: Path, names: Sequence[str], max_bytes: int | None = None) -> list[np.ndarray]:
    """The arrays `names`, each as `read` reads it."""
    return [read(path, name, max_bytes) for name in names]


def read_ragged(path: Path, key: str, others: dict[str, int]) -> list[Any]:
    """The object array `key` of uint8 arrays, and others with as many items (name -> largest bytes of an item).

    The first result is a pair: the bytes of all its arrays, concatenated, and their shapes.
    """
    file, size = _open(path, key)
    _header(file)
    sandbox.allow(3 * size, 2 * size / _BYTES_PER_SECOND)
    items = _Arrays(file, encoding="bytes").load()
    if type(items) is not np.ndarray or items.dtype != object or items.ndim != 1:
        raise ValueError(f"{key!r} must be a list of arrays")
    if wrong := [k for k, item in enumerate(items) if type(item) is not np.ndarray or item.dtype != np.uint8]:
        raise ValueError(f"{key}[{wrong[0]}] must be an array of uint8")
    total = sum(item.nbytes for item in items)
    if total > size:  # the pickle refers to the same array many times
        raise ValueError(f"the arrays of {key!r} take more bytes than the file has")
    flat = sandbox.empty((total,), np.uint8)
    np.concatenate([np.empty(0, np.uint8), *(item.reshape(-1) for item in items)], out=flat)
    shapes = [item.shape for item in items]
    return [(flat, shapes), *(read(path, name, len(items) * each) for name, each in others.items())]


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
    return _cached(path, status.st_ino, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=1)  # files are read array by array; the file status is the key for changes
def _cached(path: Path, *_: int) -> zipfile.ZipFile:
    return zipfile.ZipFile(open_file(path, limits.ARRAY_BYTES, "an npz file"))


def _open(path: Path, key: str, max_bytes: int | None = None) -> tuple[BinaryIO, int]:
    """The npy file of the array `key`, and its size. Raises ValueError if that exceeds the limit."""
    info = _archive(path).getinfo(f"{key}.npy")
    if max_bytes is None:
        max_bytes = min(limits.ARRAY_BYTES, max(limits.SMALL_BYTES, limits.EXPANSION * info.compress_size))
    if info.file_size > max_bytes + 1000:  # the header has 128 bytes
        found = f"{info.file_size} bytes, {info.file_size / max(1, info.compress_size):.0f} times its size"
        raise ValueError(f"{key!r} would unpack to {found}; the limit is {max_bytes}")
    return _archive(path).open(info), info.file_size


def _header(file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, Fortran order and dtype from the header of an npy file."""
    if (version := np.lib.format.read_magic(file)) != (1, 0):  # other versions are for large or non-ASCII headers
        raise ValueError(f"npy format {version[0]}.{version[1]} is not supported, only 1.0")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Reading `.npy`")  # Python 2's headers have numbers such as 12L
        return np.lib.format.read_array_header_1_0(file)
