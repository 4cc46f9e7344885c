"""Object arrays are read from every form that numpy writes; whatever else a pickle asks for is refused, unexecuted."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_checks import at_most
from python2_pickles import HEADER, python2_pickle, short_string
from python2_pickles import npy as npy_bytes

from learn3d.files import limits, npz, pickles


def read(path: Path, member: bytes, key: str = "images", method: int = zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr(f"{key}.npy", member)
    with npz.open_npz(path) as archive:
        return pickles.read_member(archive, key)


def object_array(*items: object) -> np.ndarray:
    array = np.empty(len(items), object)
    for k, item in enumerate(items):
        array[k] = item
    return array


IMAGES = [
    np.random.default_rng(0).integers(0, 256, (3, 2, 3), np.uint8),
    np.random.default_rng(1).integers(0, 256, (20, 7, 3), np.uint8),
]


def same(arrays: list[np.ndarray], images: list[np.ndarray]) -> None:
    assert len(arrays) == len(images)
    for one, other in zip(arrays, images, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def test_python_2s_files_are_read(tmp_path: Path) -> None:
    content = python2_pickle(IMAGES)
    same(pickle.loads(content, encoding="latin1"), IMAGES)  # the bytes of this test are a pickle for Python, too
    same(read(tmp_path / "a.npz", npy_bytes(content)), IMAGES)
    for header in (b"{'descr': '|O8', 'fortran_order': False, 'shape': (2,), }", HEADER.replace(b"%d", b"2L")):
        same(read(tmp_path / "a.npz", npy_bytes(content, header=header)), IMAGES)


@pytest.mark.parametrize("protocol", [2, 3, 4])
@pytest.mark.parametrize("module", [b"numpy.core.multiarray", b"numpy._core.multiarray"])
def test_python_3s_files_are_read(tmp_path: Path, protocol: int, module: bytes) -> None:
    images = [*IMAGES, np.asfortranarray(IMAGES[1]), IMAGES[1].astype(">f4"), IMAGES[0] > 9, IMAGES[0].astype("<i8")]
    content = pickle.dumps(object_array(*images), protocol=protocol)
    for old in (b"numpy.core.multiarray", b"numpy._core.multiarray"):
        if protocol < 4:
            content = content.replace(b"c" + old, b"c" + module)
    same(read(tmp_path / "a.npz", npy_bytes(content, len(images))), images)


def test_what_numpy_saves_is_read(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", images=object_array(*IMAGES), numbers=np.arange(6.0).reshape(2, 3).T)
    with npz.open_npz(tmp_path / "a.npz") as archive:
        assert npz.keys(archive) == ["images", "numbers"]
        same(pickles.read_member(archive, "images"), IMAGES)
        np.testing.assert_array_equal(pickles.read_member(archive, "numbers"), np.arange(6.0).reshape(2, 3).T)
        with pytest.raises(ValueError, match=r"cannot read the array 'voxels' of .*a.npz: .*\['images', 'numbers'\]"):
            pickles.read_member(archive, "voxels")
    same(read(tmp_path / "b.npz", npy_bytes(pickle.dumps(object_array()), 0)), [])


class Runs:
    """A pickle that runs a function of its choice when it is loaded."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.function, self.arguments


HOSTILE = {
    "os.system": pickle.dumps(object_array(Runs(os.system, "touch ran"), IMAGES[0]), protocol=2),
    "os.system, alone": pickle.dumps(Runs(os.system, "touch ran"), protocol=4),
    "builtins.eval": pickle.dumps(object_array(Runs(eval, "open('ran', 'w')"), IMAGES[0]), protocol=4),
    "getattr": b"\x80\x04" + b"cbuiltins\ngetattr\n" + b"cnumpy\nndarray\nX\x04\x00\x00\x00dump\x86R.",
    "a dotted name": b"\x80\x04" + b"\x8c\x05numpy\x8c\x0ff2py.os.system_\x93.",
    "numpy.ndarray.dump": b"\x80\x04" + b"\x8c\x05numpy\x8c\x0cndarray.dump\x93.",
    "np.load": b"\x80\x02cnumpy\nload\n" + short_string(b"ran") + b"\x85R.",
    "np.memmap": b"\x80\x02cnumpy\nmemmap\n" + short_string(b"ran") + b"\x85R.",
    "numpy's scalar": b"\x80\x02cnumpy.core.multiarray\nscalar\n.",
    "INST": b"\x80\x02(" + short_string(b"touch ran") + b"ios\nsystem\n.",
    "OBJ": b"\x80\x02(cos\nsystem\n" + short_string(b"touch ran") + b"o.",
    "NEWOBJ": b"\x80\x02cnumpy\nndarray\nK\x01\x85\x85\x81.",
    "an extension": b"\x80\x02\x82\x01.",
    "a persistent id": b"\x80\x02" + short_string(b"x") + b"Q.",
    "a dictionary": b"\x80\x02}.",
    "another encoding": b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00aX\x03\x00\x00\x00zip\x86R.",
    "the encoder of a tuple": b"\x80\x02c_codecs\nencode\n)X\x06\x00\x00\x00latin1\x86R.",
    "a call of a call": b"\x80\x02c_codecs\nencode\n(NNt" + b"R)R.",
    "a state for a name": b"\x80\x02cnumpy\nndarray\n(K\x01NNNNtb.",
    "protocol 0": b"cos\nsystem\n(S'true'\ntR.",
    "protocol 5": pickle.dumps(object_array(*IMAGES), protocol=5),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused_and_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"cannot read the array 'images' of .*a.npz: its pickle"):
        read(tmp_path / "a.npz", npy_bytes(HOSTILE[name]))
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_pythons_own_unpickler_would_run_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pickle.loads(HOSTILE["os.system"])
    assert Path("ran").exists()
    with pytest.raises(
        ValueError, match=r"its pickle asks for (posix|nt)\.system, which no array needs; it is refused"
    ):
        read(tmp_path / "a.npz", npy_bytes(HOSTILE["os.system"]))


def python2(images: list[np.ndarray], *changes: tuple[bytes, bytes]) -> bytes:
    content = python2_pickle(images)
    for old, new in changes:
        assert old in content
        content = content.replace(old, new)
    return content


SHAPE = b"\x8a\x02\x03\x00\x8a\x02\x02\x00\x8a\x02\x03\x00"  # (3, 2, 3)
DAMAGED = {
    "nested object arrays": (
        pickle.dumps(object_array(object_array(*IMAGES), IMAGES[0]), protocol=4),
        "must be arrays",
    ),
    "items that are no arrays": (pickle.dumps(object_array(1, "a"), protocol=4), "must be arrays"),
    "a plain array": (pickle.dumps(IMAGES[0], protocol=4), "is not that of an object array"),
    "a list": (pickle.dumps([1, 2], protocol=4), "is not that of an object array"),
    "strings": (pickle.dumps(object_array(np.array(["a"]), IMAGES[0]), protocol=4), "dtype 'U1'; only numbers"),
    "records": (pickle.dumps(object_array(np.zeros(2, "u1,u1"), IMAGES[0]), protocol=4), "dtype 'V2'; only numbers"),
    "dates": (pickle.dumps(object_array(np.zeros(2, "M8[s]"), IMAGES[0]), protocol=4), "dtype 'M8'; only numbers"),
    "a huge shape": (python2(IMAGES, (SHAPE, b"\x8a\x05\xff\xff\xff\xff\x7f" * 3)), "does not fit its data"),
    "a negative shape": (python2(IMAGES, (SHAPE, b"\x8a\x01\xff\x8a\x01\xffK\x12")), "whose shape or dtype is none"),
    "many dimensions": (python2(IMAGES, (SHAPE, b"K\x01" * 30)), "whose shape or dtype is none"),
    "a huge object array": (python2(IMAGES, (b"(\x8a\x02\x02\x00t", b"(\x8a\x05\xff\xff\xff\xff\x7ft")), "not fit its"),
    "more shape than items": (
        python2(IMAGES, (b"(\x8a\x02\x02\x00t", b"(\x8a\x02\x03\x00t")),
        "that does not fit its items",
    ),
    "a huge string": (python2(IMAGES, (b"T\x12\x00\x00\x00", b"T\xff\xff\xff\xff")), "asks for 4294967295 bytes where"),
    "a short string": (python2(IMAGES, (b"T\x12\x00\x00\x00", b"T\x11\x00\x00\x00")), "instruction"),
    "an unknown order": (python2(IMAGES, (b"u1K\x00K\x01", b"u3K\x00K\x01")), "dtype 'u3'"),
    "no end": (python2_pickle(IMAGES)[:-1], "asks for 1 bytes where 0 are left"),
    "more after the end": (python2_pickle(IMAGES) + b"x", "1 bytes follow the array"),
    "an empty stack": (b"\x80\x02R.", "takes from an empty stack"),
    "nothing stored": (b"\x80\x02h\x05.", "recalls what it never stored"),
    "a tuple without a mark": (b"\x80\x02t.", "without a mark"),
    "appending to a number": (b"\x80\x02K\x01K\x02a.", "appends to what is no list"),
    "a long name": (b"\x80\x02c" + b"n" * 300 + b"\nx\n.", "longer than 200"),
    "a numeric name": (b"\x80\x04K\x01K\x02\x93.", "where a name belongs"),
    "two values": (b"\x80\x02NN.", "is not that of an object array"),
    "too few items": (python2_pickle(IMAGES[:1]), "promises 2 items, it holds 1"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_and_strange_pickles_are_refused(tmp_path: Path, name: str) -> None:
    content, message = DAMAGED[name]
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "a.npz", npy_bytes(content))


def test_one_array_cannot_be_listed_many_times_nor_one_string_encoded_many_times(tmp_path: Path) -> None:
    big = np.random.default_rng(0).integers(0, 256, 10_000, np.uint8)
    with pytest.raises(ValueError, match="more bytes than the file has"):
        read(tmp_path / "a.npz", npy_bytes(pickle.dumps(object_array(*[big] * 50), protocol=4), 50))
    text = b"X" + struct.pack("<I", 1000) + b"a" * 1000 + b"q\x00"
    encode = b"c_codecs\nencode\nh\x00X\x06\x00\x00\x00latin1\x86R0"
    with pytest.raises(ValueError, match="makes more bytes than the file has"):
        read(tmp_path / "a.npz", npy_bytes(b"\x80\x02" + text + encode.replace(b"R0", b"R") * 20 + b"."))


def test_too_many_instructions_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "PICKLED_ARRAYS", 10)
    with pytest.raises(ValueError, match="too many instructions"):
        read(tmp_path / "a.npz", npy_bytes(b"\x80\x02" + b"]" * 5000 + b"."))
    with pytest.raises(ValueError, match=r"at most 10 items, got \(11,\)"):
        read(tmp_path / "a.npz", npy_bytes(b"", 11))


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_many_arrays_are_read_and_nothing_else_piles_up(tmp_path: Path, protocol: int) -> None:
    """12 kB in the file would become a gigabyte of marks."""
    many = [np.full((1, 2, 3), k % 256, np.uint8) for k in range(12_000)]
    items = read(tmp_path / "a.npz", npy_bytes(pickle.dumps(object_array(*many), protocol=protocol), len(many)))
    assert len(items) == 12_000 and items[11_999].tolist() == many[11_999].tolist()
    with at_most(2**25), pytest.raises(ValueError, match="too many instructions"):
        read(tmp_path / "a.npz", npy_bytes(b"\x80\x02" + b"(" * 2_000_000 + b".", 1))
    with at_most(2**25), pytest.raises(ValueError, match="piles up more than arrays need"):
        read(tmp_path / "a.npz", npy_bytes(b"\x80\x02" + b"(" * 2_000_000 + b".", 200_000))


HEADERS = {
    "a huge plain array": (
        b"{'descr': '|u1', 'fortran_order': False, 'shape': (1000000000000,), }",
        "takes 1000000000000",
    ),
    "two dimensions of objects": (b"{'descr': '|O', 'fortran_order': False, 'shape': (1, 2), }", "one-dimensional"),
    "strings": (b"{'descr': '<U1', 'fortran_order': False, 'shape': (1,), }", "must be numbers, got <U1"),
    "records": (b"{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }", "must be numbers"),
    "code": (b"__import__('os')", "header"),
}


@pytest.mark.parametrize("name", HEADERS)
def test_strange_headers_are_refused(tmp_path: Path, name: str) -> None:
    header, message = HEADERS[name]
    with pytest.raises(ValueError, match=message):
        read(tmp_path / "a.npz", npy_bytes(b"abcd", header=header))


def test_other_npy_versions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"npy format 2\.0 is not read"):
        read(tmp_path / "a.npz", b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**31))


def test_zip_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SMALL_BYTES", 100_000)
    bomb = npy_bytes(b"\0" * 1_000_000, header=b"{'descr': '|u1', 'fortran_order': False, 'shape': (1000000,), }")
    with pytest.raises(ValueError, match=r"would unpack to \d+ times its size"):
        read(tmp_path / "a.npz", bomb)
    assert len(read(tmp_path / "a.npz", bomb, method=zipfile.ZIP_STORED)) == 1_000_000
    monkeypatch.setattr(limits, "ARRAY_BYTES", 1000)
    with pytest.raises(ValueError, match="would unpack to"):
        read(tmp_path / "a.npz", bomb)
    monkeypatch.setattr(limits, "ARRAY_BYTES", 2**30)
    with npz.open_npz(tmp_path / "a.npz") as archive:
        assert len(pickles.read_member(archive, "images", max_bytes=1_000_000)) == 1_000_000
        with pytest.raises(ValueError, match="at most 2000 are read"):
            pickles.read_member(archive, "images", max_bytes=1000)


def test_a_lying_zip_directory_gives_no_more_than_it_declares(tmp_path: Path) -> None:
    path, size = tmp_path / "a.npz", struct.pack("<I", len(npy_bytes(python2_pickle(IMAGES))))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("images.npy", npy_bytes(python2_pickle(IMAGES)))
    path.write_bytes(path.read_bytes().replace(size, struct.pack("<I", 200)))
    with npz.open_npz(path) as archive, pytest.raises(ValueError, match="cannot read the array 'images'"):
        pickles.read_member(archive, "images")


def test_flipped_bits_and_cut_files_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, images=object_array(*IMAGES))
    content = bytearray(path.read_bytes())
    content[content.find(IMAGES[1].tobytes()) + 5] ^= 1
    path.write_bytes(content)
    with npz.open_npz(path) as archive, pytest.raises(ValueError, match=r"'images' of .*a.npz: Bad CRC-32"):
        pickles.read_member(archive, "images")
    path.write_bytes(content[:100])
    with pytest.raises(ValueError, match=r"a.npz is not an npz file \(.*\)$"):
        npz.open_npz(path)
    with pytest.raises(FileNotFoundError, match=r"there is no file .*b.npz"):
        npz.open_npz(tmp_path / "b.npz")


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_random_damage_never_does_anything_but_a_value_error(data: st.DataObject) -> None:
    content = bytearray(data.draw(st.sampled_from([python2_pickle(IMAGES), pickle.dumps(object_array(*IMAGES), 4)])))
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    stream = pickles._Stream(io.BytesIO(bytes(content)), len(content))
    try:
        arrays = pickles._Interpreter(stream, len(IMAGES)).run()
    except ValueError:
        return
    assert all(isinstance(array, np.ndarray) and array.dtype.kind in "biuf" for array in arrays)
