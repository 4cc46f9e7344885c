"""Mesh files and packs that somebody else may have made: what they refer to, promise, and cost."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from learn3d import limits
from learn3d.data import meshes
from learn3d.data.render import DatasetConfig, make_dataset

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"


def textured(folder: Path, texture: str) -> Path:
    """An OBJ file whose texture lies at `texture`, seen from it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "a.mtl").write_text(f"newmtl m\nmap_Kd {texture}\n")
    (folder / "a.obj").write_text("mtllib a.mtl\n" + TRIANGLE)
    return folder / "a.obj"


def red(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (4, 4), (255, 0, 0)).save(path)
    return path


def has_colours(mesh: meshes.RawMesh) -> bool:
    return bool(np.allclose(mesh.face_colors, [1, 0, 0], atol=0.02))


def test_files_that_a_mesh_refers_to_come_from_the_source_folder_only(tmp_path):
    source = tmp_path / "source"
    red(source / "images" / "t.png")
    red(tmp_path / "secret.png")
    inside = textured(source / "models", "../images/t.png")  # as in ShapeNet
    assert has_colours(meshes.read_mesh(inside, source))
    assert not has_colours(meshes.read_mesh(inside))  # its own folder alone
    for name in ("../../secret.png", str(tmp_path / "secret.png")):
        mesh = meshes.read_mesh(textured(source / "models", name), source)
        assert len(mesh.faces) == 1 and not has_colours(mesh)
    (source / "link.png").symlink_to(tmp_path / "secret.png")
    assert not has_colours(meshes.read_mesh(textured(source, "link.png"), source))
    (read,) = [s.read for s in meshes.folder_sources(source)[0] if s.name == "models/a.obj"]
    textured(source / "models", "../images/t.png")
    assert has_colours(read())


def test_buffers_from_elsewhere_are_refused(tmp_path):
    (tmp_path / "in").mkdir()
    for name, content in trimesh.Scene(trimesh.creation.box()).export(file_type="gltf").items():
        (tmp_path / "in" / name).write_bytes(content)
    assert len(meshes.read_mesh(tmp_path / "in" / "model.gltf").faces) == 12
    model = json.loads((tmp_path / "in" / "model.gltf").read_text())
    for buffer in model["buffers"]:
        (tmp_path / "in" / buffer["uri"]).rename(tmp_path / buffer["uri"])
        buffer["uri"] = "../" + buffer["uri"]
    (tmp_path / "in" / "model.gltf").write_text(json.dumps(model))
    with pytest.raises(ValueError, match=r"refers to '\.\./.*\.bin', which lies outside of"):
        meshes.read_mesh(tmp_path / "in" / "model.gltf")


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux only")
def test_a_parser_that_asks_for_much_memory_is_stopped(tmp_path, monkeypatch):
    trimesh.creation.box().export(tmp_path / "a.off")
    monkeypatch.setattr(limits, "MESH_MEMORY", 2**28)
    monkeypatch.setattr(trimesh, "load", lambda *_, **__: np.ones(2**30))
    with pytest.raises(ValueError, match=r"takes more memory than 0\.25 GiB"):
        meshes.read_mesh(tmp_path / "a.off")


def test_a_parser_that_does_not_end_is_stopped(tmp_path, monkeypatch):
    def forever(*_: object, **__: object) -> None:
        while True:
            time.sleep(0.01)

    trimesh.creation.box().export(tmp_path / "a.off")
    monkeypatch.setattr(limits, "MESH_SECONDS", 0.2)
    monkeypatch.setattr(trimesh, "load", forever)
    with pytest.raises(ValueError, match=r"reading it was stopped after 0\.2 seconds"):
        meshes.read_mesh(tmp_path / "a.off")


def test_files_beyond_the_limits(tmp_path, monkeypatch):
    trimesh.creation.box().export(tmp_path / "a.off")
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="8 vertices and 12 faces, the limits are 20"):
        patch.setattr(limits, "MESH_FACES", 11)
        meshes.read_mesh(tmp_path / "a.off")
    with monkeypatch.context() as patch, pytest.raises(ValueError, match=r"a\.off: has \d+ bytes, and at most 10"):
        patch.setattr(limits, "MESH_FILE_BYTES", 10)
        meshes.read_mesh(tmp_path / "a.off")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "b.off")
        with pytest.raises(ValueError, match="no plain file"):
            meshes.read_mesh(tmp_path / "b.off")


PACKS = {
    "n": ({"n": 10**9}, "n must be the number of meshes, at most 200000"),
    "a fraction": ({"n": 1.5}, r"n must be the number of meshes, at most 200000, got float64 \[1.5\]"),
    "negative": ({"n": -1}, "n must be the number of meshes"),
    "long": ({"n": np.arange(9)}, "would unpack|n must be the number"),
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
    (source / "cut.ply").write_bytes((source / "box0.ply").read_bytes()[:120])
    report = make_dataset(DatasetConfig(tmp_path / "data", "chair", source=source, test=1, val=0), progress=False)
    reasons = {mesh["name"]: mesh["reason"] for mesh in report.skipped}
    assert set(reasons) == {"empty.off", "points.obj", "cut.ply"} and len(report.used) == 3
    assert "no faces" in reasons["empty.off"] and "no faces" in reasons["points.obj"] and reasons["cut.ply"]
    text = (tmp_path / "data" / "03001627_report.txt").read_text()
    assert all(f"skipped {name} (" in text for name in reasons)
