"""Arrays whose archive, header and size agree are read; no other takes memory."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from memory_checks import at_most

from learn3d.data.readers.renderings import read_npz
from learn3d.files import limits, npz


def npy(header: bytes, content: bytes = b"") -> bytes:
    header = header.ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


def write(path: Path, member: bytes, name: str = "a.npy") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, member)
    return path


def read(path: Path, **options: int) -> np.ndarray:
    with npz.open_npz(path) as archive:
        return npz.read(archive, "a", **options)


@pytest.mark.parametrize("dtype", ["|u1", "<f4", ">i2", "|b1", "<f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_what_numpy_writes_is_read_and_can_be_changed(tmp_path, dtype, order):
    for shape in ((), (0,), (3,), (2, 3, 4)):
        array = np.asarray(np.arange(np.prod(shape, dtype=int)).reshape(shape) % 2, dtype=dtype, order=order)
        np.savez_compressed(tmp_path / "a.npz", a=array)
        found = read(tmp_path / "a.npz")
        np.testing.assert_array_equal(found, array)
        assert found.dtype == array.dtype and found.flags.writeable
    np.savez(tmp_path / "a.npz", a=np.arange(6), b=np.zeros(2))
    with npz.open_npz(tmp_path / "a.npz") as archive:
        assert npz.keys(archive) == ["a", "b"] and str(npz.header(archive, "a")) == "int64 [6]"


HEADERS = {
    b"{'descr': '|u1', 'fortran_order': False, 'shape': (1000000000000,), }": "takes 1000000000000 bytes, but 4 are",
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (4,), }": r"float64 \[4\] takes 32 bytes, but 4 are there",
    b"{'descr': '|u1', 'fortran_order': False, 'shape': (-4,), }": "states the shape",
    b"{'descr': '|u1', 'fortran_order': False, 'shape': (True,), }": "states the shape",
    b"{'descr': '|u1', 'fortran_order': False, 'shape': (1,1,1,1,1,1,1,1,4), }": "states the shape",
    b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }": "got pickled objects",
    b"{'descr': '<U1', 'fortran_order': False, 'shape': (1,), }": "must be numbers, got <U1",
    b"{'descr': '|b1', 'fortran_order': False, 'shape': (4,), }": "bools have values other than 0 and 1",
    b"{'descr': " + b"-" * 5000 + b"1}": "header cannot be read|Cannot parse header",
    b"{'descr': " + b"(" * 5000 + b"}": "header cannot be read|Cannot parse header",
    b"__import__('os')": "header",
}


@pytest.mark.parametrize("header", HEADERS, ids=lambda header: HEADERS[header][:25])
def test_headers_that_lie_are_refused(tmp_path, header):
    path = write(tmp_path / "a.npz", npy(header, b"abcd"))
    message = rf"cannot read the array 'a' of .*a\.npz: .*({HEADERS[header]})"
    with at_most(2**22), pytest.raises(ValueError, match=message):
        read(path)


def test_zip_bombs_are_refused_before_they_are_unpacked(tmp_path, monkeypatch):
    header = b"{'descr': '|u1', 'fortran_order': False, 'shape': (100000000,), }"
    path = write(tmp_path / "a.npz", npy(header, bytes(100_000_000)))
    assert path.stat().st_size < 200_000
    with at_most(2**22):
        with pytest.raises(ValueError, match=r"would unpack to 10\d\d times its size"):
            read(path)
        with pytest.raises(ValueError, match="would unpack to 100000128 bytes; at most 2000 are read"):
            read(path, max_bytes=1000)
        with pytest.raises(ValueError, match=r"is not an npz file \(it would unpack to 100000128 bytes; at most 1000"):
            npz.open_npz(path, most=1000)
        with pytest.raises(ValueError, match=r"a\.npz: cannot be read .*would unpack to 100000128 bytes"):
            read_npz(path, ["a"], "the cameras")
    assert read(path, max_bytes=100_000_000).nbytes == 100_000_000  # where it is known that there are so many
    monkeypatch.setattr(limits, "SMALL_BYTES", 2**30)
    assert read(path).nbytes == 100_000_000


def test_what_is_no_npz_file_is_named(tmp_path):
    content = io.BytesIO()
    np.save(content, np.zeros(3))
    (tmp_path / "a.npz").write_bytes(content.getvalue())
    with pytest.raises(ValueError, match=r"a\.npz is not an npz file \(it is a single npy array\)"):
        npz.open_npz(tmp_path / "a.npz")
    with pytest.raises(FileNotFoundError, match=r"there is no file .*b\.npz"):
        npz.open_npz(tmp_path / "b.npz")
    write(tmp_path / "a.npz", b"", "../a.npy")
    with pytest.raises(ValueError, match="points outside the archive"):
        npz.open_npz(tmp_path / "a.npz")
    write(tmp_path / "a.npz", b"", "b.npy")
    with pytest.raises(ValueError, match=r"it holds the keys \['b'\]"):
        read(tmp_path / "a.npz")
    for member in (b"", b"\x93NUMPY\x02\x00abcd", npy(b"{'descr': '|u1', 'fortran_order': False, 'shape': (4,), }")):
        with pytest.raises(ValueError, match="cannot read the array 'a'"):
            read(write(tmp_path / "a.npz", member))
