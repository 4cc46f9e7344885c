"""Files that were made to do harm, through the functions that the commands read with: one sentence, soon, in bounds."""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import struct
import sys
import threading
import time
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from PIL import Image
from python2_pickles import npy

import nmr.neural_renderer as nr
from learn3d.data.conventions import VOXEL_SIZE
from learn3d.data.framing import read_photo
from learn3d.files import meshes, npz, renderings, sandbox, volumes

SECONDS, BYTES = 10.0, 700e6
if sys.gettrace() is not None:  # the coverage of lines is measured, which slows Python down
    SECONDS *= 4
linux = pytest.mark.skipif(sys.platform != "linux", reason="memory is limited and measured on Linux only")


def _resident(pid: int | str) -> int:
    with contextlib.suppress(OSError, IndexError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
    return 0


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Fail where the block takes too long, or this process and its workers too much memory beside what they have."""
    before, most, done = _resident("self"), [0], threading.Event()

    def watch() -> None:
        while not done.wait(0.01):
            workers = sum(_resident(each.process.pid) for each in list(sandbox._workers))
            most[0] = max(most[0], _resident("self") - before + workers)

    thread = threading.Thread(target=watch)
    start = os.times()
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
    end = os.times()
    used = end.user + end.system - start.user - start.system
    assert used < SECONDS, f"it took {used:.1f} s"  # of this process; a worker has its own limit, below that
    assert most[0] < BYTES, f"it took {most[0] / 1e6:.0f} MB"


def refused(read, path: Path, *arguments: object, said: str | None = None) -> None:
    start = time.monotonic()
    with bounded(), pytest.raises(ValueError, match=said) as error:
        read(path, *arguments)
    text = str(error.value)
    assert "\n" not in text and 20 < len(text) < 1000
    assert time.monotonic() - start < 6 * SECONDS  # of the clock, on a machine that is busy


def read_mat(path: Path) -> np.ndarray:
    return sandbox.read(volumes.read_matlab, path, "Volume", VOXEL_SIZE)


def read_image(path: Path) -> object:
    return sandbox.read(renderings.read_with_alpha, path, 64)


def mat(tmp_path: Path) -> Path:
    scipy.io.savemat(tmp_path / "a.mat", {"Volume": np.zeros((VOXEL_SIZE,) * 3, np.uint8)})
    return tmp_path / "a.mat"


def test_matlab_elements_of_wrong_types(tmp_path):
    """scipy ends with a segmentation fault for some of these."""
    path = mat(tmp_path)
    content = path.read_bytes()
    for position in range(128, 200):
        for bit in (0, 1, 2, 4):
            path.write_bytes(content[:position] + bytes([content[position] ^ 1 << bit]) + content[position + 1 :])
            try:
                assert read_mat(path).shape == (VOXEL_SIZE,) * 3
            except ValueError as error:
                assert str(path) in str(error) and "crashed" not in str(error)


@linux
def test_matlab_arrays_that_unpack_to_gigabytes(tmp_path):
    path = mat(tmp_path)
    head = path.read_bytes()[:128]
    array = struct.pack("<IIIIII", 6, 8, 6, 0, 5, 12) + struct.pack("<iiiiII", 2**10, 2**10, 2**12, 0, 1, 6)
    array += b"Volume\0\0" + struct.pack("<II", 9, 2**31)
    packer = zlib.compressobj()
    content = packer.compress(struct.pack("<II", 14, 2**31 + len(array)) + array) + packer.flush(zlib.Z_FULL_FLUSH)
    zeros = packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH)
    content += 128 * zeros + packer.flush()
    path.write_bytes(head + struct.pack("<II", 15, len(content)) + content)
    refused(read_mat, path)


def test_matlab_cells_within_cells(tmp_path):
    name = struct.pack("<II", 5, 8) + struct.pack("<ii", 1, 1) + struct.pack("<II", 1, 6) + b"Volume\0\0"
    heads, size = [], 0
    for _ in range(40_000):
        size += 16 + len(name)
        heads.append(struct.pack("<IIIIII", 14, size, 6, 8, 1, 0) + name)
        size += 8
    path = mat(tmp_path)
    path.write_bytes(path.read_bytes()[:128] + b"".join(reversed(heads)))
    refused(read_mat, path)


def tiff_of_strips(path: Path, rows: int) -> Path:
    """A TIFF with a strip for each row: its table is as large as its file."""
    entries, table = [], 8 + 2 + 8 * 12 + 4
    for tag, kind, count, value in (
        (256, 4, 1, 1),
        (257, 4, 1, rows),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (273, 4, rows, table),
        (278, 4, 1, 1),
        (279, 4, rows, table + 4 * rows),
    ):
        entries.append(struct.pack("<HHII", tag, kind, count, value))
    with open(path, "wb") as file:
        file.write(b"II*\0" + struct.pack("<IH", 8, len(entries)) + b"".join(entries) + bytes(4))
        file.write(np.full(rows, 8, "<u4").tobytes() + np.full(rows, 1, "<u4").tobytes())
    return path


@linux
@pytest.mark.parametrize("read", [read_image, read_photo])
def test_tiff_of_one_row_strips(tmp_path, read):
    refused(read, tiff_of_strips(tmp_path / "a.tif", 800_000))


def jpeg_of_scans(path: Path, scans: int) -> Path:
    """A progressive JPEG that refines the same picture over and over."""
    content = io.BytesIO()
    Image.new("L", (2000, 2000)).save(content, "JPEG", progressive=True, quality=50)
    data = content.getvalue()
    starts = [k for k in range(len(data) - 1) if data[k : k + 2] == b"\xff\xda"]
    last = data[starts[-1] : -2]
    path.write_bytes(data[:-2] + last * scans + b"\xff\xd9")
    return path


@linux
def test_progressive_jpeg_of_thousands_of_scans(tmp_path):
    path = jpeg_of_scans(tmp_path / "a.jpg", 3000)
    refused(lambda p: sandbox.read(renderings.read_with_alpha, p, 64, seconds=1), path, said="processor time")


def bomb(path: Path, name: str, size: int, header: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open(name, "w", force_zip64=True) as file:
        file.write(npy(b"", header=header))
        for _ in range(size // 2**24):
            file.write(bytes(2**24))
    return path


def test_npz_bomb(tmp_path):
    size = 2**28
    header = b"{'descr': '|u1', 'fortran_order': False, 'shape': (%d,), }" % size
    path = bomb(tmp_path / "a.npz", "a.npy", size, header)
    refused(lambda p: sandbox.read(npz.read, p, "a"), path, said="times its size")


@linux
def test_object_array_bomb(tmp_path):
    """A pickle whose marks would take a gigabyte."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("images.npy", npy(b"\x80\x02" + b"]" * 30_000_000 + b"."))
    refused(lambda p: sandbox.read(npz.read_ragged, p, "images"), path)


class Runs:
    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return open, ("ran", "w")


def test_no_code_of_pickles_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    array = np.empty(1, object)
    array[0] = Runs()
    path = tmp_path / "a.npz"
    np.savez(path, images=array, a=array)
    refused(lambda p: sandbox.read(npz.read_ragged, p, "images"), path, said="asks for")
    refused(lambda p: sandbox.read(npz.read, p, "a"), path, said="pickled objects")
    path.write_bytes(pickle.dumps(Runs()))
    refused(lambda p: sandbox.read(npz.read, p, "a"), path)
    assert not (tmp_path / "ran").exists()


def test_zips_within_zips(tmp_path):
    content = zlib.compress(b"")
    for _ in range(5):
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            for k in range(16):
                archive.writestr(f"{k}.zip", content)
        content = out.getvalue()
    (tmp_path / "a.npz").write_bytes(content)
    refused(lambda p: sandbox.read(npz.read, p, "a"), tmp_path / "a.npz", said="no array")


@linux
def test_drop_in_obj_of_repeated_corners(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + "1 " * 1_950_000 + "\n")
    before = _resident("self")
    with bounded():
        _, faces = nr.load_obj(path)
    assert len(faces) == 1_949_998 and _resident("self") - before < 200e6


@linux
def test_mesh_that_takes_much_memory(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f " + "1 " * 1_950_000 + "\n")
    with bounded(), contextlib.suppress(ValueError):
        meshes.read_mesh(path)


def test_one_letter_that_is_not_utf8(tmp_path):
    path = tmp_path / "a.obj"
    path.write_bytes(b"# gr\xf6\xdfe\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert len(meshes.read_mesh(path).faces) == 1 and len(nr.load_obj(path)[1]) == 1
