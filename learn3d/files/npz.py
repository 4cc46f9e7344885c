"""Reads arrays of untrusted npz files.

NumPy stores object arrays, for example images of different sizes, as pickles. They are read in
the sandbox, and can only call the functions that make NumPy arrays, so they cannot run other
code.
"""

import contextlib
import pickle
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.reading import faults_of, open_file

_HEADER_BYTES = 1000  # longest header, as deep nesting could crash Python; ours: 128


def names(path: Path, wanted: str) -> list[str]:
    """Names of the arrays of an npz file. wanted: description of the file, for messages."""
    with _open(path, wanted) as archive:
        return [name.removesuffix(".npy") for name in archive.namelist()]


def read(path: Path, key: str, wanted: str, max_bytes: int | None = None) -> np.ndarray:
    """The array `key`, of numbers or bools.

    Raises DamagedFile for other arrays and larger ones, and MissingFile.

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
    file = _open_array(archive, key, max_bytes)
    try:
        array = np.lib.format.read_array(file, allow_pickle=False, max_header_size=_HEADER_BYTES)
    except ValueError as error:
        raise ValueError(f"{key!r} must be numbers ({error})") from None
    if array.dtype.kind not in "biuf" or file.read(1):  # zipfile compares the checksum at the end
        raise ValueError(f"{key!r} must be numbers, and as many as its header says")
    # NumPy and torch compute wrong results with them
    if array.dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError(f"the bools of {key!r} have values other than 0 and 1")
    return array


def read_ragged(path: Path, key: str, wanted: str) -> list[np.ndarray]:
    """The items of the object array `key`, all of uint8; for the sandbox."""
    with _open(path, wanted) as archive:
        file = _open_array(archive, key)
        size = archive.getinfo(f"{key}.npy").file_size
        sandbox.allow(3 * size, size / 1e7)  # a third of the speed of decompression
        np.lib.format.read_magic(file)
        np.lib.format.read_array_header_1_0(file, max_header_size=_HEADER_BYTES)
        items = _Arrays(file, encoding="bytes").load()
        if type(items) is not np.ndarray or items.dtype != object or items.ndim != 1:
            raise ValueError(f"{key!r} must be a list of arrays")
        for k, item in enumerate(items):
            if type(item) is not np.ndarray or item.dtype != np.uint8:
                raise ValueError(f"{key}[{k}] must be an array of uint8")
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
        warnings.catch_warnings(),
        open_file(path, limits.ARRAY_BYTES, wanted) as file,
        zipfile.ZipFile(file) as archive,
    ):
        # Python 2's headers have numbers such as 12L
        warnings.filterwarnings("ignore", message="Reading `.npy`")
        yield archive


def _open_array(archive: zipfile.ZipFile, key: str, max_bytes: int | None = None) -> BinaryIO:
    """The npy file of the array `key`. Raises ValueError if it is larger than the limit."""
    info = archive.getinfo(f"{key}.npy")
    if max_bytes is None:
        expected = max(limits.SMALL_BYTES, limits.EXPANSION * info.compress_size)
        max_bytes = min(limits.ARRAY_BYTES, expected)
    if info.file_size > max_bytes + _HEADER_BYTES:
        ratio = info.file_size / max(1, info.compress_size)
        found = f"{info.file_size} bytes, {ratio:.0f} times its size"
        raise ValueError(f"{key!r} would unpack to {found}; the limit is {max_bytes}")
    # zipfile unpacks others in one piece
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{key!r} is packed in a way that NumPy does not use")
    return archive.open(info)
