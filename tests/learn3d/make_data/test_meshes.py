"""Sources of meshes that somebody else may have made: names, packs, bad files, checks of arrays."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from lopsided_meshes import make

from learn3d.make_data import meshes


def names_of(*paths: str) -> list[str]:
    return meshes.object_names([meshes.MeshSource(path, None) for path in paths])


def test_names_of_objects_fit_into_names_of_files_however_many_are_alike():
    names = names_of(*("\U00020000" * 60 + f"/{k}" + "\U00020000" * 58 + ".obj" for k in range(3)))
    assert len(set(names)) == 3 and max(len(name.encode()) for name in names) <= 245
    alike = names_of(*(f"{'-' * (k % 170)}a{'+' * (k // 170)}.obj" for k in range(30_000)))  # its square takes minutes
    assert alike[::14_999] == ["a", "a_15000", "a_29999"]
    assert names_of("a.obj", "a_2.obj", "A!.obj", "-a.obj", "B.obj", "b-.obj") == ["a", "a_2", "A_3", "a_4", "B", "b_2"]


PACKS = {
    "n": ({"n": 10**9}, "n is 1000000000, missing keys"),
    "a fraction": ({"n": 1.5}, "n is 1.5"),
    "negative": ({"n": -1}, "n is -1"),
    "long": ({"n": np.arange(9)}, "no mesh pack|would unpack"),
    "objects": ({"n": np.array([{}], dtype=object)}, "pickled objects"),
    "missing": ({"n": 2}, r"missing keys: \['v1', 'f1'\]"),
    "html": (None, "cannot read the mesh pack"),
}


@pytest.mark.parametrize("name", PACKS)
def test_packs_that_are_refused(tmp_path, name):
    change, message = PACKS[name]
    path, box = tmp_path / "a.npz", trimesh.creation.box()
    path.write_text("<html>")
    if change is not None:
        np.savez(path, **({"n": 1, "v0": box.vertices, "f0": box.faces} | change))
    with pytest.raises(ValueError, match=message):
        make(tmp_path / "data", path)


def test_a_pack_becomes_a_data_set(tmp_path):
    boxes = [trimesh.creation.box((1.0, 0.2 + 0.1 * i, 0.5)) for i in range(3)]
    arrays = {f"v{i}": b.vertices.astype(np.float32) for i, b in enumerate(boxes)}
    arrays |= {f"f{i}": b.faces.astype(np.int32) for i, b in enumerate(boxes)}
    np.savez(tmp_path / "pack.npz", n=3, **arrays)
    assert make(tmp_path / "data", tmp_path / "pack.npz").objects == {"train": 3}


def test_meshes_without_faces_and_broken_files_are_skipped_and_listed(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for k in range(3):
        trimesh.creation.box(extents=(1, 1 + k, 2)).export(source / f"box{k}.ply")
    box = (source / "box0.ply").read_bytes()
    bad = {
        "empty.off": ("OFF\n0 0 0\n", "no faces"),
        "points.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no faces"),
        "nan.obj": ("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n", "not finite"),
        "point.obj": ("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "longest side"),
        "line.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no view shows"),
        "index.off": ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", ""),
        "text.obj": ("this is no mesh\n", ""),
        "cut.glb": (b"glTF\x02", ""),
        "cut.ply": (box[:120], ""),
        "huge.ply": (box.replace(b"vertex 8", b"vertex 9999999999"), ""),
        "large.stl": (trimesh.creation.icosphere(4).export(file_type="stl"), "5120 faces, the limit is 5000"),
    }
    for name, (content, _) in bad.items():
        (source / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (source / "notes.doc").write_text("no mesh")
    report = make(tmp_path / "data", source, max_faces=5000)
    reasons = {mesh["name"]: mesh["reason"] for mesh in report.skipped}
    assert reasons.keys() == bad.keys() and report.objects == {"train": 3} and report.ignored_files == {".doc": 1}
    assert all(reasons[name] and expected in reasons[name] for name, (_, expected) in bad.items())
    text = (tmp_path / "data" / "03001627_report.txt").read_text()
    assert "3 meshes used, 11 skipped" in text and "ignored 1 .doc" in text
    assert all(f"skipped {name} (train): " in text for name in bad)


TRIANGLE, FACE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]), np.array([[0, 1, 2]])


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (TRIANGLE[:, :2], FACE, "not a triangle mesh"),
        (TRIANGLE, FACE.astype(float), "not a triangle mesh"),
        (TRIANGLE, FACE + 1, r"refer to vertices 1 \.\. 3"),
        (TRIANGLE, FACE - 1, "refer to vertices -1"),
        (np.where(TRIANGLE > 0, np.inf, TRIANGLE), FACE, "not finite"),
        (TRIANGLE * 1e300, FACE, "extent"),
    ],
)
def test_arrays_that_are_refused(vertices, faces, message):
    with pytest.raises(ValueError, match=message):
        meshes.checked(meshes.RawMesh(vertices, faces), 10)


def test_vertices_that_no_face_uses_are_dropped_unchecked():
    stray = np.vstack([TRIANGLE, [[np.nan] * 3], [[50.0] * 3]])
    np.testing.assert_array_equal(meshes.checked(meshes.RawMesh(stray, FACE), 10).vertices, TRIANGLE)


def test_watertight():
    box = trimesh.creation.box((1, 1, 1))
    soup = box.vertices[box.faces].reshape(-1, 3)
    assert meshes.is_watertight(soup, np.arange(36).reshape(-1, 3))
    assert not meshes.is_watertight(box.vertices, box.faces[1:])
    two = trimesh.util.concatenate([box, box.copy().apply_translation((1, 0, 0))])  # closed parts that touch
    assert meshes.is_watertight(two.vertices, two.faces)
    assert not meshes.is_watertight(box.vertices, np.array([[0, 0, 0]]))
