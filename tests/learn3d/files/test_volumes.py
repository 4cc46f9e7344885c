"""Voxel grids in MATLAB's and binvox's formats."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from shapenet_files import binvox_bytes
from trimesh.exchange.binvox import load_binvox

from learn3d.files import limits, sandbox, volumes

CELLS = np.random.default_rng(0).random((8, 8, 8)) < 0.3


def saved(compressed: bool = False, **arrays: object) -> bytes:
    content = io.BytesIO()
    scipy.io.savemat(content, arrays, do_compression=compressed)
    return content.getvalue()


def matlab(folder: Path, content: bytes, name: str = "Volume", size: int = 8) -> np.ndarray:
    (folder / "a.mat").write_bytes(content)
    return sandbox.read(volumes.read_matlab, folder / "a.mat", name, size)


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dtype", ["u1", "?", "f8"])
def test_the_array_is_found_among_others(tmp_path, compressed, dtype):
    cell = np.array([np.zeros(2), "a"], object)
    content = saved(compressed, other=CELLS + 1, Volume=CELLS.astype(dtype), text="abc", cell=cell)
    np.testing.assert_array_equal(matlab(tmp_path, content), CELLS)
    for name, size in (("missing", 8), ("text", 8), ("cell", 8), ("Volume", 5)):
        with pytest.raises(ValueError, match=rf"a\.mat: has .*; expected .*{name}"):
            matlab(tmp_path, content, name, size)


def test_matlab_files_that_are_none(tmp_path):
    for content in (b"MATLAB", saved(Volume=CELLS)[:-5], b"", bytes(limits.VOLUME_BYTES + 1)):
        with pytest.raises(ValueError, match=r"a\.mat: "):
            matlab(tmp_path, content)


def binvox(path: Path, content: bytes, size: int = 8) -> volumes.Binvox:
    path.write_bytes(content)
    return sandbox.read(volumes.read_binvox, path, size)


def test_reads_the_axes_of_the_mesh_and_where_the_grid_lies(tmp_path):
    content = binvox_bytes(CELLS, scale=0.7, translate=-0.3)
    grid = binvox(tmp_path / "model.binvox", content)
    np.testing.assert_array_equal(grid.voxels, CELLS)
    assert grid.voxels.dtype == bool and grid.scale == 0.7 and grid.translate.tolist() == [-0.3] * 3
    np.testing.assert_array_equal(np.asarray(load_binvox(io.BytesIO(content)).matrix), CELLS)  # trimesh agrees
    assert binvox(tmp_path / "full", binvox_bytes(np.ones((32, 32, 32), bool)), 32).voxels.all()  # runs above 255


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"\ndata\n", b"\n", "its runs fill"),
        (b"dim 8 8 8", b"dim 8 8 9", "has another header; expected a binvox file of 8x8x8"),
        (b"scale 1.0", b"", "has another header"),
        (b"-0.5 -0.5 -0.5", b"-0.5 -0.5", "has another header"),
        (b"scale 1.0", b"scale nan", "and scale nan; expected"),
        (b"data\n", b"data\n\x01\x05", "cells; expected 512. Perhaps"),
    ],
)
def test_damaged_files_are_named(tmp_path, old: bytes, new: bytes, message: str):
    path = tmp_path / "model.binvox"
    with pytest.raises(ValueError) as error:
        binvox(path, binvox_bytes(CELLS).replace(old, new))
    assert str(error.value).startswith(str(path)) and message in str(error.value)
