"""Reads arrays of untrusted npz files.

NumPy stores object arrays, for example images of different sizes, as pickles. They are read in
the sandbox, and can only call the functions that make NumPy arrays, so they cannot run other
code.
"""

import contextlib
import math
import pickle
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.reading import faults_of, open_file


def names(path: Path, wanted: str) -> list[str]:
    """Names of the arrays of an npz file. wanted: description of the file, for messages."""
    with _open(path, wanted) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read(path: Path, key: str, wanted: str, max_bytes: int | None = None) -> np.ndarray:
    """The array `key`, of numbers or bools. Raises DamagedFile for other arrays and larger ones, and MissingFile.

    max_bytes: largest size; None if unknown, then large arrays with a suspicious compression
    ratio are refused.
    """
    return read_several(path, [key], wanted, max_bytes)[0]


def read_several(
    path: Path, keys: Sequence[str], wanted: str, max_bytes: int | None = None
) -> list[np.ndarray]:
    """The arrays `keys`, each as `read` reads it."""
    with _open(path, wanted) as archive:
        return [_read(archive, key, max_bytes) for key in keys]


def _read(archive: zipfile.ZipFile, key: str, max_bytes: int | None) -> np.ndarray:
    file, size, (shape, fortran, dtype) = _member(archive, key, max_bytes)
    there, content = size - file.tell(), bytearray()
    if dtype.kind not in "biuf" or math.prod(shape) * dtype.itemsize != there:
        raise ValueError(f"{key!r} must be numbers that take {there} bytes, got {dtype} {shape}")
    while piece := file.read(2**20):  # zipfile stops at the size, and compares the checksum
        content += piece
    array = np.ndarray(shape, dtype, content, order="F" if fortran else "C")
    # NumPy and torch compute wrong results with them
    if dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError(f"the bools of {key!r} have values other than 0 and 1")
    return array


def read_ragged(path: Path, key: str, wanted: str) -> list[np.ndarray]:
    """The items of the object array `key`, all of uint8; for the sandbox."""
    with _open(path, wanted) as archive:
        file, size, _ = _member(archive, key)
        sandbox.allow(3 * size, size / 1e7)  # a third of the speed of decompression
        items = _Arrays(file, encoding="bytes").load()
        if type(items) is not np.ndarray or items.dtype != object or items.ndim != 1:
            raise ValueError(f"{key!r} must be a list of arrays")
        if wrong := [
            k
            for k, item in enumerate(items)
            if type(item) is not np.ndarray or item.dtype != np.uint8
        ]:
            raise ValueError(f"{key}[{wrong[0]}] must be an array of uint8")
        # the pickle refers to the same array many times
        if sum(item.nbytes for item in items) > size:
            raise ValueError(f"the arrays of {key!r} take more bytes than the file has")
        return list(items)


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
            raise ValueError(
                f"its pickle calls {module}.{name}, which no array needs; nothing was run"
            )
        return _ALLOWED[module, name]


@contextlib.contextmanager
def _open(path: Path, wanted: str) -> Iterator[zipfile.ZipFile]:
    with (
        faults_of(path, wanted),
        open_file(path, limits.ARRAY_BYTES, wanted) as file,
        zipfile.ZipFile(file) as archive,
    ):
        yield archive


def _member(
    archive: zipfile.ZipFile, key: str, max_bytes: int | None = None
) -> tuple[BinaryIO, int, tuple[Any, ...]]:
    """The npy file of the array `key` after its header, its size, and shape, Fortran order and dtype from its header.

    Raises ValueError if it is larger than the limit.
    """
    info = archive.getinfo(f"{key}.npy")
    if max_bytes is None:
        max_bytes = min(
            limits.ARRAY_BYTES, max(limits.SMALL_BYTES, limits.EXPANSION * info.compress_size)
        )
    if info.file_size > max_bytes + 1000:  # the header has 128 bytes
        found = f"{info.file_size} bytes, {info.file_size / max(1, info.compress_size):.0f} times its size"
        raise ValueError(f"{key!r} would unpack to {found}; the limit is {max_bytes}")
    if info.compress_type not in (
        zipfile.ZIP_STORED,
        zipfile.ZIP_DEFLATED,
    ):  # zipfile unpacks others in one piece
        raise ValueError(f"{key!r} is packed in a way that NumPy does not use")
    file = archive.open(info)
    if (version := np.lib.format.read_magic(file)) != (
        1,
        0,
    ):  # other versions are for large or non-ASCII headers
        raise ValueError(f"npy format {version[0]}.{version[1]} is not supported, only 1.0")
    with warnings.catch_warnings():
        # Python 2's headers have numbers such as 12L
        warnings.filterwarnings("ignore", message="Reading `.npy`")
        # deep nesting could crash Python
        header = np.lib.format.read_array_header_1_0(file, max_header_size=1000)
    return file, info.file_size, header
