"""Arrays out of npz files: functions for worker processes, which decompress straight into shared memory.

Nothing is unpacked to disk, and no pickle runs code: NumPy stores an object array (images of different sizes, say) as a
pickle, and of what a pickle may ask for only the four functions that make NumPy's arrays are given out.
"""

from __future__ import annotations

import functools
import math
import os
import pickle
import struct
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from learn3d.files import limits, sandbox

try:
    from isal import isal_zlib as zlib  # twice as fast
except ImportError:
    import zlib

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
    """What the array `key` is, without reading it."""
    with _archive(path).open(_member(path, key)) as file:
        return _header(file)[0]


def read(path: Path, key: str, most: int | None = None) -> np.ndarray:
    """The array `key`, of numbers or bools.

    most: refuse arrays above so many bytes. None: it is not known how large it may be, and then one that unpacks to
    very many times its size is taken for a trap.
    """
    info = _member(path, key, most)
    with _archive(path).open(info) as file:
        head, fortran = _header(file)
        start = file.tell()
    size = math.prod(head.shape) * head.dtype.itemsize
    if head.dtype.kind not in "biuf":
        kind = "pickled objects" if head.dtype.hasobject else str(head.dtype)
        raise ValueError(f"the values of {key!r} must be numbers, got {kind}")
    if size != info.file_size - start:
        raise ValueError(f"{key!r} is {head}, which takes {size} bytes, but {info.file_size - start} are there")
    sandbox.allow(seconds=size / _BYTES_PER_SECOND)
    array = sandbox.empty((math.prod(head.shape),), head.dtype)
    content = array.view(np.uint8)
    at, checksum = -start, 0
    for piece in _pieces(path, info):
        checksum = zlib.crc32(piece, checksum)
        new = np.frombuffer(piece, np.uint8)[max(0, -at) :]
        content[max(0, at) : max(0, at) + len(new)] = new  # a ValueError where there is more than promised
        at += len(piece)
    if at != size or checksum != info.CRC:
        raise ValueError(f"{key!r} ends early or has another checksum than it should")
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
    if sum(item.nbytes for item in items) > info.file_size:
        raise ValueError(f"the arrays of {key!r} take more bytes than the file has")  # one of them listed many times
    flat, at = sandbox.empty((sum(item.nbytes for item in items),), np.uint8), 0
    for item in items:
        flat[at : at + item.nbytes] = item.reshape(-1)
        at += item.nbytes
    return flat, [item.shape for item in items]


def read_with_items(path: Path, key: str, others: dict[str, int]) -> list[Any]:
    """`read_ragged` of an array, and other arrays with as many items of so many bytes, at most, as it has."""
    first = read_ragged(path, key)
    count = len(first[1] if isinstance(first, tuple) else first)
    return [first, *(read(path, name, count * size) for name, size in others.items())]


class _Arrays(pickle.Unpickler):
    """Unpickles NumPy's arrays and nothing else."""

    _MAKERS = {  # noqa: RUF012
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("_codecs", "encode"): lambda text, _: text.encode("latin-1"),  # how protocol 2 writes bytes
    }

    def find_class(self, module: str, name: str) -> Any:
        if module in ("numpy.core.multiarray", "numpy._core.multiarray") and name == "_reconstruct":
            return _make
        try:
            return self._MAKERS[module, name]
        except KeyError:
            raise ValueError(f"its pickle asks for {module}.{name}, which no array needs; nothing was run") from None


def _make(kind: type, shape: Any, code: Any) -> np.ndarray:
    """An array to be filled by its state, as NumPy's function of the same place makes it."""
    return np.ndarray.__new__(np.ndarray, (0,), np.uint8)


def _archive(path: Path) -> zipfile.ZipFile:
    status = os.stat(path)
    return _opened(path, status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=1)  # a pack of meshes is asked for one after the other
def _opened(path: Path, time: int, size: int) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except (zipfile.BadZipFile, NotImplementedError, struct.error, OSError) as error:
        raise ValueError(f"it is not an npz file: {error}") from error


def _member(path: Path, key: str, most: int | None = None) -> zipfile.ZipInfo:
    """The npy file of the array `key`, if it promises no more than can be."""
    archive = _archive(path)
    try:
        info = archive.getinfo(f"{key}.npy")
    except KeyError:
        raise ValueError(f"it has no array {key!r}; it holds the keys {keys(path)[:8]}") from None
    bound = limits.ARRAY_BYTES if most is None else most + 1000  # the header has 128
    if info.file_size > bound:
        raise ValueError(f"{key!r} would unpack to {info.file_size} bytes; at most {bound} are read")
    if most is None and info.file_size > max(limits.SMALL_BYTES, limits.EXPANSION * info.compress_size):
        raise ValueError(f"{key!r} would unpack to {info.file_size / max(1, info.compress_size):.0f} times its size")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
        raise ValueError(f"{key!r} is encrypted or compressed with method {info.compress_type}")
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


def _pieces(path: Path, info: zipfile.ZipInfo) -> Iterator[bytes]:
    """The content of a member, unpacked piece by piece."""
    with open(path, "rb") as file:
        file.seek(info.header_offset + 26)
        name, extra = struct.unpack("<HH", file.read(4))
        file.seek(name + extra, 1)
        unpack = zlib.decompressobj(-15).decompress if info.compress_type == zipfile.ZIP_DEFLATED else bytes
        left = info.compress_size
        while left > 0 and (packed := file.read(min(left, 2**16))):
            left -= len(packed)
            yield unpack(packed)
