"""Voxel grids in the binvox format."""

import io

import numpy as np
import pytest
from shapenet_files import binvox_bytes
from trimesh.exchange.binvox import load_binvox

from learn3d.files.binvox import read_binvox


@pytest.fixture
def cells():
    return np.random.default_rng(0).random((8, 8, 8)) < 0.3


def test_reads_the_axes_of_the_mesh_and_where_the_grid_lies(tmp_path, cells):
    content = binvox_bytes(cells, scale=0.7, translate=-0.3)
    (tmp_path / "model.binvox").write_bytes(content)
    grid = read_binvox(tmp_path / "model.binvox", 8)
    np.testing.assert_array_equal(grid.voxels, cells)
    assert grid.voxels.dtype == bool and grid.scale == 0.7 and grid.translate.tolist() == [-0.3] * 3
    np.testing.assert_array_equal(np.asarray(load_binvox(io.BytesIO(content)).matrix), cells)  # trimesh agrees


def test_runs_longer_than_255(tmp_path):
    (tmp_path / "full").write_bytes(binvox_bytes(np.ones((32, 32, 32), bool)))
    assert read_binvox(tmp_path / "full", 32).voxels.all()


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
    path.write_bytes(FAULTS[message](binvox_bytes(cells)))
    with pytest.raises(ValueError) as error:
        read_binvox(path, 8)
    assert str(error.value).startswith(str(path)) and message in str(error.value)


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(FileNotFoundError, match="is missing; expected a voxel grid in the binvox format"):
        read_binvox(tmp_path / "model.binvox", 8)
    with pytest.raises(ValueError, match="cannot be read"):
        read_binvox(tmp_path, 8)
