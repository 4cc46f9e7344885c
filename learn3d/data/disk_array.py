"""Arrays on disk. Rows are read on demand, and compared with their checksums."""

from __future__ import annotations

import dataclasses
import itertools
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from learn3d.files.reading import DamagedFile, FaultHandler, attempt, open_file

MAX_BYTES = 2**45  # size of a file
_ROWS_AT_ONCE = 256  # rows that `check` reads at a time
WANTED = "a shard of a data set"
CHANGED = "its content has changed since it was written: another CRC-32"
#: A row of an array: the number of its file, its number in the file, and its CRC-32.
ROW = np.dtype([("file", np.int32), ("row", np.int32), ("crc", np.uint32)])


@dataclass(frozen=True, eq=False)
class DiskArray:
    """An array [M, ...] on disk, whose rows are in some files.

    `array[samples]` reads rows, int64 [B].

    Files are not mapped into memory: if a mapped file is truncated later, a signal ends the
    process. Here a DamagedFile with its name is raised.
    """

    files: tuple[tuple[Path, int], ...]  # (file, position of its first row in bytes)
    rows: np.ndarray  # ROW [M]
    row_shape: tuple[int, ...]
    dtype: np.dtype

    @classmethod
    def join(cls, parts: Sequence[DiskArray]) -> DiskArray:
        """Concatenate several arrays. Raises ValueError if their rows differ in shape or dtype."""
        if len({(part.row_shape, part.dtype) for part in parts}) != 1:
            raise ValueError("the arrays have rows of different shapes or types")
        rows = np.concatenate([part.rows for part in parts])
        starts = np.cumsum([0] + [len(part.files) for part in parts])[:-1]
        rows["file"] += np.repeat(starts, [len(part) for part in parts]).astype(np.int32)
        return dataclasses.replace(
            parts[0], files=tuple(file for part in parts for file in part.files), rows=rows
        )

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def shape(self) -> tuple[int, ...]:
        """(M, ...)."""
        return (len(self), *self.row_shape)

    def select(self, samples: np.ndarray) -> DiskArray:
        """The array of the rows `samples`, int64 [B]; nothing is read."""
        return dataclasses.replace(self, rows=self.rows[samples])

    def digest(self) -> int:
        """CRC-32 of the checksums of all rows."""
        return zlib.crc32(np.ascontiguousarray(self.rows["crc"]))

    def check(self, on_fault: FaultHandler) -> None:
        """Read all rows; report the first fault of each file."""
        for number in range(len(self.files)):
            rows = np.flatnonzero(self.rows["file"] == number)
            for part in np.array_split(rows, len(rows) // _ROWS_AT_ONCE + 1):
                if attempt(on_fault, self.__getitem__, part) is None:
                    break

    def __getitem__(self, samples: np.ndarray) -> np.ndarray:
        file_of, row_of, crc_of = (self.rows[samples][name] for name in ROW.names)
        result = np.empty((len(row_of), *self.row_shape), self.dtype)
        size = math.prod(self.row_shape)
        content = result.reshape(len(row_of), size).view(np.uint8)
        for number, samples_of_file in itertools.groupby(
            np.lexsort((row_of, file_of)), key=file_of.__getitem__
        ):
            path, position = self.files[number]
            try:
                with open_file(path, MAX_BYTES, WANTED) as file:
                    for k in samples_of_file:
                        file.seek(position + int(row_of[k]) * content.shape[1])
                        if file.readinto(content[k]) != content.shape[1]:
                            raise OSError("it ends early")
                        if zlib.crc32(content[k]) != crc_of[k]:
                            raise ValueError(CHANGED)
                        # such bools compute wrongly
                        if self.dtype == np.bool_ and content[k].max() > 1:
                            raise ValueError("its bools have values other than 0 and 1")
                        if self.dtype.kind == "f" and not np.isfinite(result[k]).all():
                            raise ValueError("it has numbers that are not finite")
            except (OSError, ValueError) as error:
                text = error.message if isinstance(error, DamagedFile) else str(error)
                raise DamagedFile(
                    path, f"cannot be used any more ({text}); make or copy it again"
                ) from error
        return result
