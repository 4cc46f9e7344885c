"""Folders and packs of meshes that somebody else may have made."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from learn3d.make_data import meshes
from learn3d.make_data.render import DatasetConfig, make_dataset


def test_names_of_objects_fit_into_names_of_files_however_many_are_alike():
    paths = ["\U00020000" * 60 + f"/{k}" + "\U00020000" * 58 + ".obj" for k in range(3)]
    names = meshes.object_names([meshes.MeshSource(path, None) for path in paths])
    assert len(set(names)) == 3 and max(len(name.encode()) for name in names) <= 245
    alike = [
        meshes.MeshSource(f"{'-' * (k % 170)}a{'+' * (k // 170)}.obj", None) for k in range(30_000)
    ]  # the square of it takes minutes
    assert meshes.object_names(alike)[::14_999] == ["a", "a_15000", "a_29999"]
    strange = [meshes.MeshSource(path, None) for path in ("a.obj", "a_2.obj", "A!.obj", "-a.obj", "B.obj", "b-.obj")]
    assert meshes.object_names(strange) == ["a", "a_2", "A_3", "a_4", "B", "b_2"]


PACKS = {
    "n": ({"n": 10**9}, "n is 1000000000, missing keys"),
    "a fraction": ({"n": 1.5}, "n is 1.5"),
    "negative": ({"n": -1}, "n is -1"),
    "long": ({"n": np.arange(9)}, "no mesh pack|would unpack"),
    "objects": ({"n": np.array([{}], dtype=object)}, "pickled objects"),
    "missing": ({"n": 2}, "missing keys: .*v1"),
}


@pytest.mark.parametrize("name", PACKS)
def test_packs_that_are_none(tmp_path, name):
    change, message = PACKS[name]
    box = trimesh.creation.box()
    np.savez(tmp_path / "a.npz", **({"n": 1, "v0": box.vertices, "f0": box.faces} | change))
    with pytest.raises(ValueError, match=message):
        meshes.pack_sources(tmp_path / "a.npz")


def test_meshes_without_faces_and_broken_files_are_skipped_and_listed(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for k in range(3):
        trimesh.creation.box(extents=(1, 1 + k, 2)).export(source / f"box{k}.ply")
    (source / "empty.off").write_text("OFF\n0 0 0\n")
    (source / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    box = (source / "box0.ply").read_bytes()
    (source / "cut.ply").write_bytes(box[:120])
    (source / "huge.ply").write_bytes(box.replace(b"vertex 8", b"vertex 9999999999"))
    report = make_dataset(
        DatasetConfig(output=tmp_path / "data", category="chair", source=source, test=1, val=0), progress=False
    )
    reasons = {mesh["name"]: mesh["reason"] for mesh in report.skipped}
    assert set(reasons) == {"empty.off", "points.obj", "cut.ply", "huge.ply"} and len(report.used) == 3
    assert "no faces" in reasons["empty.off"] and "no faces" in reasons["points.obj"] and reasons["cut.ply"]
    text = (tmp_path / "data" / "03001627_report.txt").read_text()
    assert all(f"skipped {name} (" in text for name in reasons)
