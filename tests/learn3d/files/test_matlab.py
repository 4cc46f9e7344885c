"""One array of numbers is found in a MATLAB file, and scipy is shown nothing else."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
import pytest
import scipy.io
from memory_checks import at_most

from learn3d.files import limits
from learn3d.files.matlab import read_matlab

VOLUME = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)


def saved(compressed: bool = False, **arrays: object) -> bytes:
    content = io.BytesIO()
    scipy.io.savemat(content, arrays, do_compression=compressed)
    return content.getvalue()


def read(tmp_path, content: bytes, name: str = "Volume"):
    (tmp_path / "a.mat").write_bytes(content)
    return read_matlab(tmp_path / "a.mat", name, "a volume")


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "?", "f4", "f8", "i4"])
def test_the_array_is_found_among_others(tmp_path, compressed, dtype):
    cell = np.array([np.zeros(2), "a"], object)
    content = saved(compressed, other=VOLUME + 1, Volume=VOLUME.astype(dtype), text="abc", cell=cell)
    found = read(tmp_path, content)
    np.testing.assert_array_equal(found, VOLUME.astype(dtype))
    assert read(tmp_path, content, "missing") is None
    assert read(tmp_path, content, "text") is None and read(tmp_path, content, "cell") is None


def test_short_and_long_names(tmp_path):
    for name in ("V", "Vol4", "a_name_that_is_rather_long"):
        assert read(tmp_path, saved(**{name: VOLUME}), name).shape == (2, 3, 4)


def test_what_unpacks_to_more_than_it_may_is_refused(tmp_path):
    bomb = saved(True, Volume=np.zeros((2000, 2000, 2)))
    assert len(bomb) < 100_000
    with (
        at_most(3 * limits.VOLUME_BYTES),
        pytest.raises(ValueError, match=r"a\.mat: cannot be read .*unpacks to more than 4194304 bytes"),
    ):
        read(tmp_path, bomb)
    with pytest.raises(ValueError, match="at most 4194304 are read"):
        read(tmp_path, bytes(limits.VOLUME_BYTES + 1))


def test_cells_within_cells_are_never_entered(tmp_path):
    """scipy's parser would call itself until the stack overflows."""
    name = struct.pack("<II", 5, 8) + struct.pack("<ii", 1, 1) + struct.pack("<II", 1, 0)
    inner = b""
    for _ in range(40_000):
        body = struct.pack("<IIII", 6, 8, 1, 0) + name + inner
        if len(body) > limits.VOLUME_BYTES - 300:
            break
        inner = struct.pack("<II", 14, len(body)) + body
    head = saved()[:128]
    assert read(tmp_path, head + inner) is None


def test_sizes_that_cannot_be_are_refused(tmp_path):
    content = saved(Volume=VOLUME)
    at = content.index(struct.pack("<iii", 2, 3, 4))
    for dims in ((2**31 - 1, 2**31 - 1, 2), (-1, 3, 4)):
        with pytest.raises(ValueError, match=r"the array 'Volume' has the size"):
            read(tmp_path, content[:at] + struct.pack("<iii", *dims) + content[at + 12 :])
    with pytest.raises(ValueError, match="cannot be read"):
        read(tmp_path, content[:at] + struct.pack("<iii", 5, 5, 5) + content[at + 12 :])
    with pytest.raises(ValueError, match="it ends early"):
        read(tmp_path, content[:-5])
    with pytest.raises(ValueError, match="is no MATLAB file of version 5 to 7"):
        read(tmp_path, b"MATLAB")
    packed = zlib.compress(struct.pack("<II", 14, 999) + b"short")
    with pytest.raises(ValueError, match="an array of 5 bytes says it has 999"):
        read(tmp_path, content[:128] + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(FileNotFoundError, match="is missing; expected a volume"):
        read_matlab(tmp_path / "none.mat", "Volume", "a volume")
