"""Voxel grids in MATLAB's and binvox's formats."""

from __future__ import annotations

import io

import numpy as np
import pytest
import scipy.io
from shapenet_files import binvox_bytes
from trimesh.exchange.binvox import load_binvox

from learn3d.files import limits, sandbox, volumes

VOLUME = np.random.default_rng(0).random((4, 4, 4)) < 0.3


def saved(compressed: bool = False, **arrays: object) -> bytes:
    content = io.BytesIO()
    scipy.io.savemat(content, arrays, do_compression=compressed)
    return content.getvalue()


def matlab(folder, content: bytes, name: str = "Volume", size: int = 4):
    (folder / "a.mat").write_bytes(content)
    return sandbox.read(volumes.read_matlab, folder / "a.mat", name, size)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "?", "f4", "f8", "i4"])
def test_the_array_is_found_among_others(tmp_path, compressed, dtype):
    cell = np.array([np.zeros(2), "a"], object)
    content = saved(compressed, other=VOLUME + 1, Volume=VOLUME.astype(dtype), text="abc", cell=cell)
    np.testing.assert_array_equal(matlab(tmp_path, content), VOLUME)
    for name in ("missing", "text", "cell"):
        with pytest.raises(ValueError, match="expected"):
            matlab(tmp_path, content, name)
    with pytest.raises(ValueError, match=r"has \w+ \[4, 4, 4\]"):
        matlab(tmp_path, content, size=5)


def test_matlab_files_that_are_none(tmp_path):
    for content in (b"MATLAB", saved(Volume=VOLUME)[:-5], b"", bytes(limits.VOLUME_BYTES + 1)):
        with pytest.raises(ValueError, match=r"a\.mat: "):
            matlab(tmp_path, content)
    with pytest.raises(FileNotFoundError, match="is missing"):
        sandbox.read(volumes.read_matlab, tmp_path / "none.mat", "Volume", 4)


def binvox(path, content: bytes, size: int = 8):
    path.write_bytes(content)
    return sandbox.read(volumes.read_binvox, path, size)


@pytest.fixture
def cells():
    return np.random.default_rng(0).random((8, 8, 8)) < 0.3


def test_reads_the_axes_of_the_mesh_and_where_the_grid_lies(tmp_path, cells):
    content = binvox_bytes(cells, scale=0.7, translate=-0.3)
    grid = binvox(tmp_path / "model.binvox", content)
    np.testing.assert_array_equal(grid.voxels, cells)
    assert grid.voxels.dtype == bool and grid.scale == 0.7 and grid.translate.tolist() == [-0.3] * 3
    np.testing.assert_array_equal(np.asarray(load_binvox(io.BytesIO(content)).matrix), cells)  # trimesh agrees


def test_runs_longer_than_255(tmp_path):
    assert binvox(tmp_path / "full", binvox_bytes(np.ones((32, 32, 32), bool)), 32).voxels.all()


FAULTS = {
    "has no such header": lambda content: content.replace(b"#binvox", b"#boxvin"),
    "has no such header; expected": lambda content: content.replace(b"\ndata\n", b"\n"),
    "such header": lambda content: content.replace(b"dim 8 8 8", b"dim 8 8 eight"),
    "no such header": lambda content: content.replace(b"scale 1.0", b""),
    "holds 8x8x9 cells; expected 8x8x8": lambda content: content.replace(b"dim 8 8 8", b"dim 8 8 9"),
    "has translate [-0.5 -0.5] and scale 1.0": lambda content: content.replace(b"-0.5 -0.5 -0.5", b"-0.5 -0.5"),
    "and scale 0.0; expected": lambda content: content.replace(b"scale 1.0", b"scale 0.0"),
    "and scale nan; expected": lambda content: content.replace(b"scale 1.0", b"scale nan"),
    "cells; expected 512. Perhaps": lambda content: content[:-20],
    "its runs fill": lambda content: content + b"\x01\x05",
}


@pytest.mark.parametrize("message", FAULTS)
def test_damaged_files_are_named(tmp_path, cells, message):
    path = tmp_path / "model.binvox"
    with pytest.raises(ValueError) as error:
        binvox(path, FAULTS[message](binvox_bytes(cells)))
    assert str(error.value).startswith(str(path)) and message in str(error.value)
