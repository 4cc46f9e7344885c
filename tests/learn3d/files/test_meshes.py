"""Meshes that are refused, and glTF's skins. Those that are read: `test_kinds.py`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from gltf_files import Arrays

from learn3d.files.formats import read_mesh
from learn3d.files.reading import FETCH_AGAIN, DamagedFile


def gltf(**changes: object) -> str:
    """A triangle."""
    arrays = Arrays()
    arrays.add(np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    tree = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}]} | arrays.tree(embedded=True)
    tree["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    return json.dumps(tree | changes)


PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
PLY += "property list uchar int vertex_indices\nend_header\n"
BUFFER = {"buffer": 0, "byteLength": 36}
REFUSED = {
    "required.gltf": (
        gltf(extensionsRequired=["KHR_draco_mesh_compression"]),
        "needs the extension KHR_draco_mesh",
    ),
    "unknown.gltf": (
        gltf(extensionsRequired=["ACME_shapes"]),
        "needs the extension ACME_shapes, which is not",
    ),
    "many.gltf": (
        gltf(nodes=[{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]),
        "EXT_mesh_gpu_instancing",
    ),
    "old.gltf": (gltf(asset={"version": "1.0"}), "it is glTF 1.0"),
    "loop.gltf": (
        gltf(nodes=[{"children": [1]}, {"children": [0]}], scenes=[{"nodes": [0]}]),
        "several parents",
    ),
    "lines.gltf": (
        gltf(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "mode": 1}]}]),
        "no faces",
    ),
    "short.gltf": (
        gltf(bufferViews=[BUFFER | {"byteOffset": 4}]),
        "an array of 3 elements exceeds its buffer",
    ),
    "elsewhere.gltf": (
        gltf(buffers=[{"byteLength": 36, "uri": "../a.bin"}]),
        "'../a.bin', which is outside of",
    ),
    "nan.ply": (PLY + "0 0 0 1 0 nan 0 1 0 3 0 1 2", "1 of its corners are not finite"),
    "one.ply": (PLY + "1 2 3 1 2 3 1 2 3 3 0 1 2", "all its corners are at one place"),
    "far.ply": (PLY + "0 0 0 1 0 0 0 1 0 3 0 1 3", "missing vertex; there are 3"),
    "negative.ply": (PLY + "0 0 0 1 0 0 0 1 0 -3 0 1 2", "a list has a negative length"),
    "strips.ply": (
        PLY.replace("face", "tristrips") + "0 0 0 1 0 0 0 1 0 3 0 1 2",
        "triangle strips",
    ),
    "web.off": ("<html></html>", "does not begin with OFF"),
    "empty.gltf": ("{}", "it is glTF without a version"),
    "web.glb": ("<html></html>", "begins with neither glTF nor {"),
    "web.ply": ("<html></html>", "does not begin with the line `ply`"),
    "corner.off": (
        "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n",
        "a face has fewer corners than it says",
    ),
    "corner.stl": (
        "solid\nfacet\nvertex 0 0 0\nvertex 1 0 0\nendfacet\nendsolid",
        "1 facets and 2 corners",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_meshes_that_are_refused(tmp_path: Path, name: str) -> None:
    content, said = REFUSED[name]
    (tmp_path / name).write_text(content)
    with pytest.raises(DamagedFile, match=said) as error:
        read_mesh(tmp_path / name)
    assert FETCH_AGAIN not in str(error.value)


def test_a_missing_buffer_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.gltf").write_text(gltf(buffers=[{"byteLength": 36, "uri": "b.bin"}]))
    with pytest.raises(FileNotFoundError, match=r"b\.bin: is missing"):
        read_mesh(tmp_path / "a.gltf")


def test_skins_and_morph_targets_move_corners(tmp_path: Path) -> None:
    """Joint 0 is moved by 5 in x. Joint 1 is at y = 2, scaled by 2, and was bound there unscaled."""
    binds = np.stack([np.eye(4)] * 2)
    binds[1, 1, 3] = -2
    arrays = Arrays()
    attributes = {
        "POSITION": arrays.add(np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])),
        "JOINTS_0": arrays.add(np.uint8([[0, 1, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0]])),
        "WEIGHTS_0": arrays.add(np.float32([[0.5, 0.5, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]])),
    }
    target = {"POSITION": arrays.add(np.float32([[0, 0, 0], [0, 0, 4], [0, 0, 0]]))}
    inverse = arrays.add(binds.swapaxes(1, 2).astype(np.float32))
    tree = {
        "meshes": [
            {"primitives": [{"attributes": attributes, "targets": [target]}], "weights": [0.5]}
        ],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": inverse}],
        "nodes": [
            {"mesh": 0, "skin": 0, "translation": [100, 0, 0]},  # has no effect
            {"translation": [5, 0, 0]},
            {"translation": [0, 2, 0], "scale": [2, 2, 2]},
        ],
    }
    (tmp_path / "a.gltf").write_text(gltf(**tree, **arrays.tree(embedded=True)))
    found = read_mesh(tmp_path / "a.gltf").vertices
    assert found == pytest.approx(np.array([[2.5, -1, 0], [6, 0, 2], [0, 0, 0]]))
