"""Hostile files, read with the functions of the commands: errors of one sentence, within limits of memory and time."""

from __future__ import annotations

import contextlib
import io
import os
import struct
import sys
import threading
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from gltf_files import glb
from PIL import Image
from python2_pickles import npy

import nmr.neural_renderer as nr
from learn3d.data.framing import read_photo
from learn3d.files import formats, images, npz, sandbox

SECONDS, BYTES = 10.0, 700e6
if sys.gettrace() is not None:  # the coverage of lines is measured, which slows Python down
    SECONDS *= 4
pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="memory is limited and measured on Linux only"
)


def _resident(pid: int | str) -> int:
    with contextlib.suppress(OSError, IndexError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
    return 0


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Fail if the block takes too long, or this process and its workers too much memory beside what they have."""
    before, most, done = _resident("self"), [0], threading.Event()

    def watch() -> None:
        while not done.wait(0.01):
            workers = sum(_resident(each.process.pid) for each in list(sandbox._workers))
            most[0] = max(most[0], _resident("self") - before + workers)

    thread = threading.Thread(target=watch)
    start = time.process_time()
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
    used = time.process_time() - start
    # of this process; a worker has its own limit, below that
    assert used < SECONDS, f"it took {used:.1f} s"
    assert most[0] < BYTES, f"it took {most[0] / 1e6:.0f} MB"


def read_mat(path: Path) -> np.ndarray:
    return sandbox.read(formats.read_matlab, path, "Volume", 32)


def read_image(path: Path, seconds: float = sandbox.SECONDS) -> object:
    return sandbox.read(images.read_with_depth, path, path.with_name("none"), 64, seconds=seconds)


def read_npz(path: Path) -> object:
    return npz.read(path, "a", "an array")


def read_ragged(path: Path) -> object:
    return sandbox.read(npz.read_ragged, path, "images", "images")


def mat(path: Path) -> bytes:
    scipy.io.savemat(path, {"Volume": np.zeros((32, 32, 32), np.uint8)})
    return path.read_bytes()


def mat_of_gigabytes(path: Path) -> None:
    head = mat(path)[:128]
    array = struct.pack("<IIIIII", 6, 8, 6, 0, 5, 12) + struct.pack(
        "<iiiiII", 2**10, 2**10, 2**12, 0, 1, 6
    )
    array += b"Volume\0\0" + struct.pack("<II", 9, 2**31)
    packer = zlib.compressobj()
    content = packer.compress(struct.pack("<II", 14, 2**31 + len(array)) + array) + packer.flush(
        zlib.Z_FULL_FLUSH
    )
    zeros = packer.compress(bytes(2**24)) + packer.flush(zlib.Z_FULL_FLUSH)
    content += 128 * zeros + packer.flush()
    path.write_bytes(head + struct.pack("<II", 15, len(content)) + content)


def mat_of_cells_within_cells(path: Path) -> None:
    name = (
        struct.pack("<II", 5, 8)
        + struct.pack("<ii", 1, 1)
        + struct.pack("<II", 1, 6)
        + b"Volume\0\0"
    )
    heads, size = [], 0
    for _ in range(40_000):
        size += 16 + len(name)
        heads.append(struct.pack("<IIIIII", 14, size, 6, 8, 1, 0) + name)
        size += 8
    path.write_bytes(mat(path)[:128] + b"".join(reversed(heads)))


def tiff_of_one_row_strips(path: Path) -> None:
    """Its table is as large as its file."""
    rows, entries, table = 6_000_000, [], 8 + 2 + 8 * 12 + 4
    values = {256: 1, 257: rows, 258: 8, 259: 1, 262: 1, 273: table, 278: 1, 279: table + 4 * rows}
    for tag, value in values.items():
        entries.append(struct.pack("<HHII", tag, 4, rows if tag in (273, 279) else 1, value))
    with open(path, "wb") as file:
        file.write(b"II*\0" + struct.pack("<IH", 8, len(entries)) + b"".join(entries) + bytes(4))
        file.write(np.full(rows, 8, "<u4").tobytes() + np.full(rows, 1, "<u4").tobytes())


def jpeg_of_thousands_of_scans(path: Path) -> None:
    """It refines the same picture over and over."""
    content = io.BytesIO()
    Image.new("L", (2000, 2000)).save(content, "JPEG", progressive=True, quality=50)
    data = content.getvalue()
    last = data[data.rindex(b"\xff\xda") : -2]
    path.write_bytes(data[:-2] + last * 3000 + b"\xff\xd9")


def npz_bomb(path: Path) -> None:
    size = 2**28
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w") as file,
    ):
        file.write(
            npy(b"", header=b"{'descr': '|u1', 'fortran_order': False, 'shape': (%d,), }" % size)
        )
        for _ in range(size // 2**24):
            file.write(bytes(2**24))


def pickle_of_many_lists(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("images.npy", npy(b"\x80\x02" + b"]" * 30_000_000 + b"."))


def zips_within_zips(path: Path) -> None:
    content = zlib.compress(b"")
    for _ in range(5):
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            for k in range(16):
                archive.writestr(f"{k}.zip", content)
        content = out.getvalue()
    path.write_bytes(content)


def glb_of_a_great_array(path: Path) -> None:
    accessor = {"bufferView": 0, "componentType": 5126, "count": 10**9, "type": "VEC3"}
    scene = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [accessor],
        "bufferViews": [{"buffer": 0, "byteLength": 10**10}],
        "buffers": [{"byteLength": 4}],
    }
    path.write_bytes(glb(scene, bytes(4)))


def write_text(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text)


PLY = "ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nend_header\n"
HOSTILE: dict[str, tuple[Callable[[Path], object], Callable[[Path], object], str]] = {
    "a.mat": (mat_of_gigabytes, read_mat, "memory"),
    "cells.mat": (mat_of_cells_within_cells, read_mat, "expected"),
    "a.tif": (tiff_of_one_row_strips, read_image, "expected an image in the format PNG"),
    "photo.tif": (tiff_of_one_row_strips, read_photo, "expected an image in the format PNG"),
    "a.jpg": (jpeg_of_thousands_of_scans, lambda path: read_image(path, 1.0), "processor time"),
    "a.npz": (npz_bomb, read_npz, "times its size"),
    "lists.npz": (pickle_of_many_lists, read_ragged, "memory|processor time"),
    "zips.npz": (zips_within_zips, read_npz, "no item"),
    "a.ply": (write_text(PLY), formats.read_mesh, "cannot be read"),
    "a.off": (
        write_text("OFF\n2000000000 2000000000 0\n0 0 0\n"),
        formats.read_mesh,
        "cannot be read",
    ),
    "a.glb": (glb_of_a_great_array, formats.read_mesh, "cannot be read"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_end_in_one_sentence(tmp_path: Path, name: str) -> None:
    write, read, said = HOSTILE[name]
    path = tmp_path / name
    write(path)
    start = time.monotonic()
    with bounded(), pytest.raises(ValueError, match=said) as error:
        read(path)
    text = str(error.value)
    assert "\n" not in text and len(text) < 1000
    assert time.monotonic() - start < 6 * SECONDS  # of the clock, on a machine that is busy


def test_matlab_elements_of_wrong_types(tmp_path: Path) -> None:
    """For some of these scipy crashes its process."""
    path = tmp_path / "a.mat"
    content = mat(path)
    for position in range(128, 200, 3):
        path.write_bytes(
            content[:position] + bytes([content[position] ^ 4]) + content[position + 1 :]
        )
        with contextlib.suppress(ValueError):
            assert read_mat(path).shape == (32, 32, 32)


@pytest.mark.parametrize("read", [nr.load_obj, formats.read_mesh])
def test_a_polygon_of_two_million_corners(tmp_path: Path, read: Callable[[Path], object]) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + "1 " * 1_950_000 + "\n")
    with bounded(), contextlib.suppress(ValueError):
        read(path)
