"""Arrays on disk of which only the rows that are asked for are read."""

from __future__ import annotations

import dataclasses
import struct
import threading
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from learn3d.files.findings import DamagedFile
from learn3d.files.reading import check_file

_MOST = 2**45  # bytes of a file


@dataclass(frozen=True, eq=False)
class StoredArray:
    """An array [M, ...] of the rows of .npy files, one file after the other. `array[rows]` reads rows, int64 [B].

    Nothing else of it is kept in memory. Files are opened for each reading, and read without mapping them: one that is
    cut short later is an error that names it, not a crash.
    """

    files: tuple[Path, ...]
    offsets: tuple[int, ...]  # of the first row in each file, in bytes
    starts: np.ndarray  # int64 [files + 1]: number of the first row of each, and of all
    crcs: tuple[int, ...]  # CRC-32 of each file's rows, as it was written
    row: tuple[int, ...]  # shape of a row
    dtype: np.dtype
    chosen: np.ndarray | None = None  # int64 [M]: only these rows of the files, in this order
    _ahead: list = field(default_factory=list)  # (rows, thread, result) that `prepare` has begun to read

    @classmethod
    def open(cls, path: Path, rows: int, row: tuple[int | None, ...], dtype: type, crc: int) -> StoredArray:
        """One file, whose header must say rows [rows, *row] of this type; DamagedFile where it does not, or is cut
        short. A None in `row` stands for any number."""
        shape, dtype = (rows, *row), np.dtype(dtype)
        wanted = f"{dtype} [{', '.join('P' if n is None else str(n) for n in shape)}] in a .npy file"
        size = check_file(path, _MOST, wanted)
        try:
            with open(path, "rb") as file:
                version = np.lib.format.read_magic(file)
                read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
                found, fortran, kind = read[version](file)
                start = file.tell()
        except (OSError, ValueError, KeyError) as error:
            raise DamagedFile(path, f"cannot be read ({error}); expected {wanted}") from error
        fits = len(found) == len(shape) and all(n in (None, m) for n, m in zip(shape, found, strict=True))
        if not fits or kind != dtype or fortran:
            raise DamagedFile(path, f"holds {kind} {list(found)}; expected {wanted}")
        if size != start + int(np.prod(found, dtype=object)) * dtype.itemsize:
            raise DamagedFile(path, f"has {size} bytes, which is not what its header says; expected {wanted}")
        return cls((path,), (start,), np.array([0, rows]), (crc,), tuple(found[1:]), dtype)

    @classmethod
    def join(cls, parts: Sequence[StoredArray]) -> StoredArray:
        """The rows of several arrays, one after the other. ValueError where their rows differ in shape or type."""
        first = parts[0]
        if any((p.row, p.dtype) != (first.row, first.dtype) for p in parts):
            raise ValueError("the arrays have rows of different shapes or types")
        counts = [n for p in parts for n in np.diff(p.starts)]
        starts = np.cumsum([0, *counts])
        chosen = None
        if any(p.chosen is not None for p in parts):
            begin = np.cumsum([0] + [p.starts[-1] for p in parts])
            chosen = np.concatenate([p._numbers(np.arange(len(p))) + b for p, b in zip(parts, begin, strict=False)])
        files, offsets, crcs = (sum((getattr(p, name) for p in parts), ()) for name in ("files", "offsets", "crcs"))
        return cls(files, offsets, starts, crcs, first.row, first.dtype, chosen)

    def __len__(self) -> int:
        return int(self.starts[-1]) if self.chosen is None else len(self.chosen)

    @property
    def shape(self) -> tuple[int, ...]:
        """(M, ...)."""
        return (len(self), *self.row)

    @property
    def ndim(self) -> int:
        """Number of dimensions."""
        return 1 + len(self.row)

    def select(self, rows: np.ndarray) -> StoredArray:
        """The array of these rows, int64 [B]; nothing is read."""
        return dataclasses.replace(self, chosen=self._numbers(rows), _ahead=[])

    def crc(self) -> int:
        """What tells this array from others: CRC-32 of the checksums of its files, and of the choice of rows."""
        crc = zlib.crc32(struct.pack(f"<{len(self.crcs)}I", *self.crcs))
        return crc if self.chosen is None else zlib.crc32(np.ascontiguousarray(self.chosen), crc)

    def prepare(self, rows: np.ndarray) -> None:
        """Begin to read rows that will be asked for next, in a thread."""
        result: list[np.ndarray | Exception] = []

        def read() -> None:
            try:
                result.append(self._read(rows))
            except Exception as error:
                result.append(error)

        thread = threading.Thread(target=read, daemon=True)
        self._ahead[:] = [(rows, thread, result)]
        thread.start()

    def __getitem__(self, rows: np.ndarray) -> np.ndarray:
        rows = np.asarray(rows)
        if rows.ndim != 1 or rows.dtype.kind not in "iu":
            raise TypeError(f"rows of an array on disk are read by their numbers, int64 [B], got {rows!r}")
        if self._ahead and np.array_equal(self._ahead[0][0], rows):
            _, thread, results = self._ahead.pop()
            thread.join()
            if isinstance(results[0], Exception):
                raise results[0]
            return results[0]
        return self._read(rows)

    def _read(self, rows: np.ndarray) -> np.ndarray:
        rows = self._numbers(rows)
        out = np.empty((len(rows), *self.row), self.dtype)
        if not len(out):
            return out
        size = out[0].nbytes
        bytes_of_rows = out.reshape(len(rows), -1).view(np.uint8)
        file_of = np.searchsorted(self.starts, rows, side="right") - 1
        order = np.argsort(rows, kind="stable")
        at = 0
        while at < len(order):
            number = file_of[order[at]]
            path = self.files[number]
            try:
                with open(path, "rb", buffering=0) as file:
                    while at < len(order) and file_of[order[at]] == number:
                        k = order[at]
                        file.seek(self.offsets[number] + int(rows[k] - self.starts[number]) * size)
                        if file.readinto(bytes_of_rows[k]) != size:
                            raise OSError("it ends early")
                        at += 1
            except OSError as error:
                raise DamagedFile(path, f"cannot be read any more ({error}); make or copy this shard again") from error
        return out

    def _numbers(self, rows: np.ndarray) -> np.ndarray:
        """Numbers of rows in the files."""
        return np.asarray(rows, np.int64) if self.chosen is None else self.chosen[rows]
