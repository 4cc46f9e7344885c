"""Arrays out of npz files: functions for the sandbox, which decompress straight into shared memory.

No pickle runs code: NumPy stores an object array (images of different sizes, say) as a pickle, and a pickle is given
the four functions that make NumPy's arrays and nothing else.
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
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.reading import open_file

_BYTES_PER_SECOND = 3e7  # ten times slower than decompression is


class Header(NamedTuple):
    """What an array's header states."""

    dtype: np.dtype
    shape: tuple[int, ...]

    def __str__(self) -> str:
        return f"{self.dtype} {list(self.shape)}"


def keys(path: Path) -> list[str]:
    """Names of the arrays in an npz file."""
    return [name.removesuffix(".npy") for name in _archive(path).namelist()]


def header(path: Path, key: str) -> Header:
    """Type and shape of the array `key`, which is not read."""
    with _archive(path).open(_member(path, key)) as file:
        return _header(file)[0]


def read(path: Path, key: str, most: int | None = None) -> np.ndarray:
    """The array `key`, of numbers or bools.

    most: bytes above which an array is refused. None: unknown, and an array that unpacks to very many times its size is
    taken for a trap.
    """
    info = _member(path, key, most)
    with _archive(path).open(info) as file:
        head, fortran = _header(file)
        size, there = math.prod(head.shape) * head.dtype.itemsize, info.file_size - file.tell()
        if head.dtype.kind not in "biuf":
            kind = "pickled objects" if head.dtype.hasobject else str(head.dtype)
            raise ValueError(f"the values of {key!r} must be numbers, got {kind}")
        if size != there:
            raise ValueError(f"{key!r} is {head}, which takes {size} bytes, but {there} are there")
        sandbox.allow(seconds=size / _BYTES_PER_SECOND)
        array, at = sandbox.empty((math.prod(head.shape),), head.dtype), 0
        content = array.view(np.uint8)
        while piece := file.read(2**20):  # zipfile compares the checksum at the end
            content[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
            at += len(piece)
    if at != size:
        raise ValueError(f"{key!r} ends early")
    if head.dtype.kind == "b" and size and content.max() > 1:  # such bools compute wrongly
        raise ValueError(f"the bools of {key!r} have values other than 0 and 1")
    return array.reshape(head.shape, order="F" if fortran else "C")


def read_those_there(path: Path, names: Iterable[str], most: int) -> dict[str, np.ndarray]:
    """Those of the named arrays that a file has, each of at most so many bytes."""
    there = set(keys(path))
    return {name: read(path, name, most) for name in names if name in there}


def read_ragged(path: Path, key: str) -> np.ndarray | tuple[np.ndarray, list[tuple[int, ...]]]:
    """An array of numbers as it is; of an object array its uint8 arrays one after the other, flat, and their shapes."""
    info = _member(path, key)
    with _archive(path).open(info) as file:
        if not _header(file)[0].dtype.hasobject:
            return read(path, key)
        sandbox.allow(3 * info.file_size, 2 * info.file_size / _BYTES_PER_SECOND)
        items = _Arrays(file, encoding="bytes").load()
    if type(items) is not np.ndarray or items.dtype != object or items.ndim != 1:
        raise ValueError(f"{key!r} is no list of arrays")
    for k, item in enumerate(items):
        if type(item) is not np.ndarray or item.dtype != np.uint8:
            raise ValueError(f"{key}[{k}] must be an array of uint8, got {getattr(item, 'dtype', type(item).__name__)}")
    size = sum(item.nbytes for item in items)
    if size > info.file_size:  # one of them is listed many times
        raise ValueError(f"the arrays of {key!r} take more bytes than the file has")
    flat = sandbox.empty((size,), np.uint8)
    np.concatenate([item.reshape(-1) for item in items], out=flat) if len(items) else None
    return flat, [item.shape for item in items]


def read_with_items(path: Path, key: str, others: dict[str, int]) -> list[Any]:
    """`read_ragged` of an array, and other arrays with as many items of so many bytes, at most, as it has."""
    first = read_ragged(path, key)
    count = len(first[1] if isinstance(first, tuple) else first)
    return [first, *(read(path, name, count * size) for name, size in others.items())]


def _make_array(kind: type, shape: Any, code: Any) -> np.ndarray:
    """An array to be filled by its state, as NumPy's `_reconstruct` makes it."""
    return np.empty(0, np.uint8)


_ALLOWED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("numpy.core.multiarray", "_reconstruct"): _make_array,
    ("numpy._core.multiarray", "_reconstruct"): _make_array,
    ("_codecs", "encode"): lambda text, _: text.encode("latin-1"),  # for bytes in protocol 2
}


class _Arrays(pickle.Unpickler):
    """Unpickles NumPy's arrays and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise ValueError(f"its pickle asks for {module}.{name}, which no array needs; nothing was run")
        return _ALLOWED[module, name]


def _archive(path: Path) -> zipfile.ZipFile:
    status = os.stat(path)
    return _opened(path, status.st_ino, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=1)  # the arrays of a pack of meshes are asked for one after the other
def _opened(path: Path, *_: int) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(open_file(path, limits.ARRAY_BYTES, "an npz file"))
    except zipfile.BadZipFile as error:
        raise ValueError(f"it is not an npz file: {error}") from error


def _member(path: Path, key: str, most: int | None = None) -> zipfile.ZipInfo:
    """The npy file of the array `key`, if it promises no more bytes than it may have."""
    archive = _archive(path)
    try:
        info = archive.getinfo(f"{key}.npy")
    except KeyError:
        raise ValueError(f"it has no array {key!r}; it holds the keys {keys(path)[:8]}") from None
    if most is None:
        most = min(limits.ARRAY_BYTES, max(limits.SMALL_BYTES, limits.EXPANSION * info.compress_size))
    if info.file_size > most + 1000:  # the header has 128
        times = info.file_size / max(1, info.compress_size)
        raise ValueError(f"{key!r} would unpack to {info.file_size} bytes, {times:.0f} times its size; at most {most}")
    return info


def _header(file: BinaryIO) -> tuple[Header, bool]:
    """The header of an npy file, and whether its axes are in Fortran's order."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Reading `.npy`")  # Python 2's headers have numbers such as 12L
        version = np.lib.format.read_magic(file)
        if version != (1, 0):  # others are for records with very many fields
            raise ValueError(f"npy format {version[0]}.{version[1]} is not read here, only 1.0")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"its header states the shape {str(shape)[:100]}")
    return Header(dtype, shape), fortran
