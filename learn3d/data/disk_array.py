"""Arrays on disk. Rows are read on demand, and compared with their checksums."""

from __future__ import annotations

import dataclasses
import itertools
import math
import zlib
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from learn3d.files.reading import DamagedFile, open_file

MAX_BYTES = 2**45  # size of a file
WANTED = "a shard of a data set"
_reader = ThreadPoolExecutor(1, "read ahead")


@dataclass(frozen=True, eq=False)
class DiskArray:
    """An array [M, ...] on disk, a selection of the R rows of some files. `array[samples]` reads rows, int64 [B].

    Files are not mapped into memory: if a mapped file is truncated later, a signal ends the process. Here a DamagedFile
    with its name is raised.
    """

    files: tuple[tuple[Path, int], ...]  # (file, position of its first row in bytes)
    starts: np.ndarray  # int64 [files + 1]: number of the first row of each file, and R
    checksums: np.ndarray  # uint32 [R]: CRC-32 of each row
    row_shape: tuple[int, ...]
    dtype: np.dtype
    rows: np.ndarray  # int64 [M] in 0 .. R-1: the rows of this array
    _ahead: dict[bytes, Future] = field(default_factory=dict)  # bytes of `samples` -> rows that `prepare` reads

    @classmethod
    def join(cls, parts: Sequence[DiskArray]) -> DiskArray:
        """Concatenate several arrays. Raises ValueError if their rows differ in shape or dtype."""
        if len({(part.row_shape, part.dtype) for part in parts}) != 1:
            raise ValueError("the arrays have rows of different shapes or types")
        begins = np.cumsum([0] + [part.starts[-1] for part in parts])[:-1]
        ends = [part.starts[1:] + begin for part, begin in zip(parts, begins, strict=True)]
        return dataclasses.replace(
            parts[0],
            files=tuple(file for part in parts for file in part.files),
            starts=np.concatenate([[0], *ends]),
            checksums=np.concatenate([part.checksums for part in parts]),
            rows=np.concatenate([part.rows + begin for part, begin in zip(parts, begins, strict=True)]),
            _ahead={},
        )

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def shape(self) -> tuple[int, ...]:
        """(M, ...)."""
        return (len(self), *self.row_shape)

    def select(self, samples: np.ndarray) -> DiskArray:
        """The array of the rows `samples`, int64 [B]; nothing is read."""
        return dataclasses.replace(self, rows=self.rows[samples], _ahead={})

    def digest(self) -> int:
        """CRC-32 of the checksums of all rows."""
        return zlib.crc32(self.checksums[self.rows])

    def prepare(self, samples: np.ndarray) -> None:
        """Start a thread that reads the rows `samples`, int64 [B], for the next `array[samples]`."""
        self._ahead.clear()
        self._ahead[samples.tobytes()] = _reader.submit(self._read, samples)

    def __getitem__(self, samples: np.ndarray) -> np.ndarray:
        if not isinstance(samples, np.ndarray) or samples.ndim != 1 or samples.dtype.kind not in "iu":
            raise TypeError(f"the index of an array on disk must be an integer array [B], got {samples!r}")
        future = self._ahead.pop(samples.tobytes(), None)
        return self._read(samples) if future is None else future.result()

    def _read(self, samples: np.ndarray) -> np.ndarray:
        rows = self.rows[samples]
        result = np.empty((len(rows), *self.row_shape), self.dtype)
        content = result.reshape(len(rows), math.prod(self.row_shape)).view(np.uint8)
        size = content.shape[1]
        file_of = np.searchsorted(self.starts, rows, side="right") - 1
        for number, samples_of_file in itertools.groupby(np.argsort(rows), key=file_of.__getitem__):
            path, position = self.files[number]
            try:
                with open_file(path, MAX_BYTES, WANTED) as file:
                    for k in samples_of_file:
                        file.seek(position + int(rows[k] - self.starts[number]) * size)
                        if file.readinto(content[k]) != size:
                            raise OSError("it ends early")
                        if zlib.crc32(content[k]) != self.checksums[rows[k]]:
                            raise ValueError("its content has changed since it was written: another CRC-32")
                        if self.dtype == np.bool_ and content[k].max() > 1:  # such bools compute wrongly
                            raise ValueError("its bools have values other than 0 and 1")
                        if self.dtype.kind == "f" and not np.isfinite(result[k]).all():
                            raise ValueError("it has numbers that are not finite")
            except (OSError, ValueError) as error:
                text = error.message if isinstance(error, DamagedFile) else str(error)
                raise DamagedFile(path, f"cannot be used any more ({text}); make or copy it again") from error
        return result
