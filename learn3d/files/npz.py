"""Arrays of numbers out of npz files, none taken into memory before the archive and the array's header agree on it."""

from __future__ import annotations

import contextlib
import math
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from learn3d.files import limits
from learn3d.files.archives import open_zip
from learn3d.files.reading import check_file

_FAULTS = (OSError, EOFError, ValueError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error)
_PIECE = 2**20


@dataclass(frozen=True)
class Header:
    """What an array's header states."""

    dtype: np.dtype
    shape: tuple[int, ...]
    fortran: bool

    @property
    def nbytes(self) -> int:
        """The size of its data."""
        return math.prod(self.shape) * self.dtype.itemsize

    def __str__(self) -> str:
        return f"{self.dtype} {list(self.shape)}"


def open_npz(path: Path | str, *, most: int | None = None) -> zipfile.ZipFile:
    """Open an npz archive that unpacks to at most `most` bytes (None: 16 GiB).

    Raises FileNotFoundError, and ValueError for what is no zip archive or one that `archives.open_zip` refuses.
    """
    most = limits.ARRAY_BYTES if most is None else most
    try:
        check_file(path, most + limits.ZIP_DIRECTORY_BYTES, "an npz file")
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no file {path}") from None
    try:
        with open(path, "rb") as file:
            if file.read(6) == b"\x93NUMPY":
                raise ValueError("it is a single npy array")
        return open_zip(Path(path), most)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is not an npz file ({error})") from None


def keys(archive: zipfile.ZipFile) -> list[str]:
    """Names of the arrays in the archive."""
    return [name.removesuffix(".npy") for name in archive.namelist()]


def header(archive: zipfile.ZipFile, key: str) -> Header:
    """What the array `key` is, without reading it. Raises ValueError, naming file and key, as `read` does."""
    with open_member(archive, key, max_bytes=limits.ARRAY_BYTES) as (file, _):
        return read_header(file)


def read(archive: zipfile.ZipFile, key: str, *, max_bytes: int | None = None) -> np.ndarray:
    """The array `key` of the archive, of numbers or bools.

    max_bytes: refuse arrays larger than that. None: it is not known how large they may be, and then one that unpacks
    to very many times its size is taken for a trap.

    Raises ValueError, naming file and key, where the key is missing, the file damaged, or the array of another kind.
    """
    with open_member(archive, key, max_bytes=max_bytes) as (file, left):
        head = read_header(file)
        check_size(head, left - file.tell())
        content = np.empty(head.nbytes, np.uint8)
        rest = memoryview(content)
        while len(rest):
            if not (count := file.readinto(rest[:_PIECE])):
                raise ValueError("it ends early")
            rest = rest[count:]
        if file.read(1):  # reading to the end is what makes zipfile compare the checksum
            raise ValueError("bytes follow the array")
        return from_bytes(content, head)


@contextlib.contextmanager
def open_member(archive: zipfile.ZipFile, key: str, *, max_bytes: int | None = None) -> Iterator[tuple[BinaryIO, int]]:
    """The npy file of the array `key` and its size in bytes; what goes wrong in the block names file and key."""
    try:
        try:
            info = archive.getinfo(f"{key}.npy")
        except KeyError:
            raise ValueError(f"it holds the keys {_some(keys(archive))}") from None
        most = limits.ARRAY_BYTES if max_bytes is None else min(limits.ARRAY_BYTES, max_bytes + 1000)  # header: 128
        if info.file_size > most:
            raise ValueError(f"it would unpack to {info.file_size} bytes; at most {most} are read")
        if max_bytes is None and info.file_size > max(limits.SMALL_BYTES, limits.EXPANSION * info.compress_size):
            raise ValueError(f"it would unpack to {info.file_size / max(1, info.compress_size):.0f} times its size")
        with archive.open(info) as file:
            yield file, info.file_size
    except _FAULTS as error:
        raise ValueError(f"cannot read the array {key!r} of {archive.filename}: {error}") from error


def read_header(file: BinaryIO) -> Header:
    """The header of an npy file; ValueError for one that numpy does not write for plain arrays."""
    version = np.lib.format.read_magic(file)
    if version != (1, 0):  # others are for records with very many fields
        raise ValueError(f"npy format {version[0]}.{version[1]} is not read here, only 1.0")
    try:
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except Exception as error:  # the parser of Python's literals raises whatever a strange header leads it to
        raise ValueError(f"its header cannot be read ({type(error).__name__}: {error})") from error
    if len(shape) > 8 or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"its header states the shape {str(shape)[:100]}")
    return Header(dtype, shape, fortran)


def check_size(head: Header, left: int) -> None:
    """Raise ValueError where an array of numbers does not take exactly the `left` bytes that are there."""
    if head.dtype.kind not in "biuf":
        pickled = "pickled objects" if head.dtype.hasobject else str(head.dtype)
        raise ValueError(f"its values must be numbers, got {pickled}")
    if head.nbytes != left:
        raise ValueError(f"{head} takes {head.nbytes} bytes, but {left} are there")


def from_bytes(content: np.ndarray | bytes, head: Header) -> np.ndarray:
    """The array that `content` holds; ValueError for bools that are neither 0 nor 1, which compute wrongly."""
    if head.dtype.kind == "b" and len(content) and np.frombuffer(content, np.uint8).max() > 1:
        raise ValueError("its bools have values other than 0 and 1")
    array = np.frombuffer(content, head.dtype) if isinstance(content, bytes) else content.view(head.dtype)
    return array.reshape(head.shape, order="F" if head.fortran else "C")


def _some(names: list[str]) -> str:
    return f"{names[:8]}" + (f" and {len(names) - 8} more" if len(names) > 8 else "")
