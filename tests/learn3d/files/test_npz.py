"""Arrays of npz files: those from numpy are read, damaged and hostile files are refused."""

from __future__ import annotations

import os
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from python2_pickles import HEADER, npy, python2_pickle

from learn3d.files import npz, sandbox

RNG = np.random.default_rng(0)
IMAGES = [RNG.integers(0, 256, shape, np.uint8) for shape in ((3, 2, 3), (20, 7, 3))]
UINT8 = b"{'descr': '|u1', 'fortran_order': False, 'shape': (%d,), }"


def write(path: Path, member: bytes, method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("a.npy", member)
    return path


def read(path: Path, max_bytes: int | None = None) -> np.ndarray:
    return npz.read(path, "a", "an array", max_bytes)


def refused(path: Path, said: str = "", max_bytes: int | None = None) -> None:
    with pytest.raises(ValueError, match=rf"a\.npz: cannot be read .*{said}"):
        read(path, max_bytes)


def ragged(path: Path, member: bytes) -> list[np.ndarray]:
    return sandbox.read(npz.read_ragged, write(path, member), "a", "images")


def object_array(*items: object) -> np.ndarray:
    array = np.empty(len(items), object)
    for k, item in enumerate(items):
        array[k] = item
    return array


@pytest.mark.parametrize("dtype", ["|u1", ">i2", "|b1", "<f8"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_what_numpy_writes_is_read_and_can_be_changed(tmp_path, dtype, order):
    for k, shape in enumerate(((), (0,), (2, 3, 4), (300, 20, 200))):
        array = np.asarray(
            np.arange(np.prod(shape, dtype=int)).reshape(shape) % 2, dtype=dtype, order=order
        )
        (np.savez_compressed if k % 2 else np.savez)(
            tmp_path / "a.npz", a=array
        )  # another file of the same name
        found = read(tmp_path / "a.npz")
        np.testing.assert_array_equal(found, array)
        assert found.dtype == array.dtype and found.flags.writeable


def test_names_and_arrays_with_items(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.arange(6), images=object_array(*IMAGES), boxes=np.ones((2, 4)))
    assert npz.names(path, "arrays") == ["a", "images", "boxes"]
    assert [array.shape for array in npz.read_several(path, ["boxes", "a"], "arrays")] == [
        (2, 4),
        (6,),
    ]
    same(sandbox.read(npz.read_ragged, path, "images", "images"), IMAGES)


HEADERS = {
    UINT8 % 10**12: "memory|EOF",
    UINT8 % 5: "EOF",
    UINT8 % 3: "must be numbers, and as many as its header says",
    b"{'descr': '|u1', 'fortran_order': False, 'shape': (-4,), }": "negative",
    b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }": "Object arrays",
    b"{'descr': '<U1', 'fortran_order': False, 'shape': (1,), }": "must be numbers",
    b"{'descr': '|b1', 'fortran_order': False, 'shape': (4,), }": "bools",
    b"{'descr': " + b"(" * 5000 + b"}": "",
    b"__import__('os')": "malformed",
}


@pytest.mark.parametrize("header", HEADERS, ids=lambda header: header[:40])
def test_headers_that_lie_are_refused(tmp_path, header):
    refused(write(tmp_path / "a.npz", npy(b"abcd", header=header)), HEADERS[header])


def test_zip_bombs_are_refused(tmp_path):
    path = write(tmp_path / "a.npz", npy(bytes(100_000_000), header=UINT8 % 100_000_000))
    assert path.stat().st_size < 200_000
    refused(path, r"would unpack to \d+ bytes, 10\d\d times its size")
    refused(path, "the limit is 1000", max_bytes=1000)
    assert read(path, 100_000_000).nbytes == 100_000_000  # if it is known that there are so many


def test_what_is_no_npz_file(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(npy(b"abcd", header=UINT8 % 4))
    refused(path, "not a zip file")
    np.savez(path, b=np.zeros(3))
    refused(path, "no item named 'a.npy'")
    refused(
        write(path, npy(b"abcd", header=UINT8 % 4), zipfile.ZIP_BZIP2),
        "in a way that NumPy does not use",
    )
    for member in (b"", b"\x93NUMPY\x02\x00abcd", npy(b"", header=UINT8 % 4)):
        refused(write(path, member))


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_damage_and_a_table_of_contents_that_lies_are_noticed(tmp_path, method):
    member = npy(RNG.integers(0, 256, 10_000, np.uint8).tobytes(), header=UINT8 % 10_000)
    path = write(tmp_path / "a.npz", member, method)
    content, size = path.read_bytes(), struct.pack("<I", len(member))
    flipped = [content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :] for at in (1000, 5000)]
    lies = [content.replace(size, struct.pack("<I", n)) for n in (200, 10**9)]
    for damaged in (*flipped, *lies, content[:100], content[:-10]):
        path.write_bytes(damaged)
        refused(path)


def same(arrays: list[np.ndarray], images: list[np.ndarray]) -> None:
    for one, other in zip(arrays, images, strict=True):
        np.testing.assert_array_equal(one, other)


def test_python_2s_object_arrays_are_read(tmp_path):
    content = python2_pickle(IMAGES)
    # the bytes of this test are a pickle for Python, too
    same(pickle.loads(content, encoding="latin1"), IMAGES)
    for header in (
        None,
        b"{'descr': '|O8', 'fortran_order': False, 'shape': (2,), }",
        HEADER.replace(b"%d", b"2L"),
    ):
        same(ragged(tmp_path / "a.npz", npy(content, header=header)), IMAGES)


@pytest.mark.parametrize("protocol", [2, 4])
@pytest.mark.parametrize("module", [b"numpy.core.multiarray", b"numpy._core.multiarray"])
def test_python_3s_object_arrays_are_read(tmp_path, protocol, module):
    images = [*IMAGES, np.asfortranarray(IMAGES[1])]
    content = pickle.dumps(object_array(*images), protocol=protocol)
    if protocol < 4:
        for name in (b"numpy.core.multiarray", b"numpy._core.multiarray"):
            content = content.replace(b"c" + name, b"c" + module)
    same(ragged(tmp_path / "a.npz", npy(content, len(images))), images)


class Runs:
    """A pickle that runs a function of its choice when it is loaded."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[object, tuple[Any, ...]]:
        return self.function, self.arguments


HOSTILE = {
    "os.system": pickle.dumps(object_array(Runs(os.system, "touch ran"), IMAGES[0]), protocol=2),
    "builtins.eval": pickle.dumps(
        object_array(Runs(eval, "open('ran', 'w')"), IMAGES[0]), protocol=4
    ),
    "getattr": b"\x80\x04"
    + b"cbuiltins\ngetattr\n"
    + b"cnumpy\nndarray\nX\x04\x00\x00\x00dump\x86R.",
    "a dotted name": b"\x80\x04" + b"\x8c\x05numpy\x8c\x0ff2py.os.system_\x93.",
    "INST": b"\x80\x02(X\x09\x00\x00\x00touch ranios\nsystem\n.",
    "OBJ": b"\x80\x02(cos\nsystem\nX\x09\x00\x00\x00touch rano.",
    "protocol 0": b"cos\nsystem\n(S'true'\ntR.",
    "nested object arrays": pickle.dumps(
        object_array(object_array(*IMAGES), IMAGES[0]), protocol=4
    ),
    "items that are no arrays": pickle.dumps(object_array(1, "a"), protocol=4),
    "a plain array": pickle.dumps(IMAGES[0], protocol=4),
    "one array many times": pickle.dumps(object_array(*[IMAGES[1]] * 500), protocol=4),
    "cut short": python2_pickle(IMAGES)[:-1],
    "a great array": b"\x80\x02cnumpy\nndarray\n\x8a\x06\x00\x00\x00\x00\x00\x10\x85\x85R.",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused_and_not_run(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"a.npz: "):
        ragged(tmp_path / "a.npz", npy(HOSTILE[name]))
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_pythons_own_unpickler_would_run_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickle.loads(HOSTILE["os.system"])
    assert Path("ran").exists()
