"""Sources of meshes that somebody else may have made: names, packs, bad files, checks of arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from lopsided_meshes import make

from learn3d.make_data import meshes


def test_names_of_objects_are_fit_for_files_and_differ_by_more_than_case() -> None:
    paths = ("a.obj", "a_2.obj", "A!.obj", "-a.obj", "b/c d.ply", "..ply.ply", "!.stl", "x" * 300 + ".off")
    names = meshes.object_names(paths)
    assert names == ["a", "a_2", "A_3", "a_4", "b_c_d", "ply", "mesh", "x" * 80]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (None, "an npz file with v0"),
        ({"n": 3}, "there is no mesh"),
        ({"v0": np.array([{}], dtype=object)}, "pickled objects"),
        ({"v0": np.eye(3)}, "f0"),
    ],
)
def test_packs_that_are_refused(tmp_path: Path, arrays: dict | None, message: str) -> None:
    path = tmp_path / "a.npz"
    path.write_text("<html>")
    if arrays is not None:
        np.savez(path, **arrays)
    with pytest.raises(ValueError, match=message):
        make(tmp_path / "data", path)


def test_a_pack_becomes_a_data_set(tmp_path: Path) -> None:
    boxes = [trimesh.creation.box((1.0, 0.2 + 0.1 * i, 0.5)) for i in range(3)]
    arrays = {f"v{i}": b.vertices.astype(np.float32) for i, b in enumerate(boxes)}
    arrays |= {f"f{i}": b.faces.astype(np.int32) for i, b in enumerate(boxes)}
    np.savez(tmp_path / "pack.npz", n=3, **arrays)
    assert make(tmp_path / "data", tmp_path / "pack.npz").counts == {"train": 3}


def test_meshes_without_faces_and_broken_files_are_skipped_and_listed(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for k in range(3):
        trimesh.creation.box(extents=(1, 1 + k, 2)).export(source / f"box{k}.ply")
    box = (source / "box0.ply").read_bytes()
    bad = {
        "empty.off": ("OFF\n0 0 0\n", "no faces"),
        "points.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
        "nan.obj": ("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", "longest side is nan"),
        "point.obj": ("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "longest side is 0"),
        "line.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no view shows"),
        "index.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", ""),
        "text.obj": ("this is no mesh\n", ""),
        "cut.glb": (b"glTF\x02", ""),
        "cut.ply": (box[:120], ""),
        "huge.ply": (box.replace(b"vertex 8", b"vertex 9999999999"), ""),
    }
    for name, (content, _) in bad.items():
        (source / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    report = make(tmp_path / "data", source)
    reasons = {mesh["name"]: mesh["reason"] for mesh in report.skipped}
    assert reasons.keys() == bad.keys() and report.counts == {"train": 3}
    assert all(reasons[name] and expected in reasons[name] for name, (_, expected) in bad.items())
    assert "3 meshes used, 10 skipped" in report.text()
    assert all(f"skipped {name} (train): " in report.text() for name in bad)


TRIANGLE, FACE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (TRIANGLE[:, :2], FACE, "not a triangle mesh"),
        (TRIANGLE, FACE.astype(float), "not a triangle mesh"),
        (TRIANGLE, FACE + 1, r"refer to vertices 1 \.\. 3"),
        (TRIANGLE, FACE - 1, "refer to vertices -1"),
        (np.where(TRIANGLE > 0, np.inf, TRIANGLE), FACE, "extent"),
        (TRIANGLE, np.broadcast_to(FACE, (meshes.MOST_FACES + 1, 3)), "1000001 faces, the limit is 1000000"),
    ],
)
def test_arrays_that_are_refused(vertices: np.ndarray, faces: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        meshes.checked(meshes.RawMesh(vertices, faces))


def test_vertices_that_no_face_uses_are_dropped_unchecked() -> None:
    stray = np.vstack([TRIANGLE, [[np.nan] * 3], [[50.0] * 3]])
    np.testing.assert_array_equal(meshes.checked(meshes.RawMesh(stray, FACE)).vertices, TRIANGLE)
