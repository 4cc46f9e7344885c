"""Mesh files and packs that somebody else may have made: what they refer to, promise, and cost."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import EpsImagePlugin, Image

from learn3d.files import limits
from learn3d.make_data import meshes
from learn3d.make_data.render import DatasetConfig, make_dataset

PILLOWS_OPEN = Image.open
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


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n%%EOF\n"


@pytest.mark.skipif(os.name != "posix", reason="Ghostscript is played by a shell script")
@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_textures_run_no_programs(tmp_path, monkeypatch, kind):
    ran, program = tmp_path / "ran", tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {ran}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)  # what it found before
    path = textured(tmp_path / "source", "t.png")
    red(path.with_name("t.png"))
    if kind == "glb":
        content = trimesh.load(path, force="scene", process=False).export(file_type="glb")
        start = content.index(b"\x89PNG")
        length = content.index(b"IEND") + 8 - start
        assert length >= len(EPS)
        path = path.with_suffix(".glb")
        path.write_bytes(content[:start] + EPS.ljust(length) + content[start + length :])
    else:
        path.with_name("t.png").write_bytes(EPS)
    mesh = meshes.read_mesh(path)
    assert len(mesh.faces) == 1 and not has_colours(mesh) and not ran.exists()
    assert Image.open is PILLOWS_OPEN


@pytest.mark.parametrize("kind", ["png", "tga", "gif", "ppm", "bmp", "tiff", "webp"])
def test_textures_of_the_usual_formats_are_read(tmp_path, kind):
    red(tmp_path / f"t.{kind}")
    assert has_colours(meshes.read_mesh(textured(tmp_path, f"t.{kind}")))


def test_a_texture_that_cannot_be_read_does_not_cost_the_mesh(tmp_path):
    path = red(tmp_path / "t.png")
    path.write_bytes(path.read_bytes()[:50])
    mesh = meshes.read_mesh(textured(tmp_path, "t.png"))
    assert len(mesh.faces) == 1 and not has_colours(mesh)


def test_what_trimesh_passes_over_is_not_printed(tmp_path):
    header = b"ply\nformat ascii 1.0\ncomment TextureFile \x1b[2J.png\nelement vertex 3\nproperty float x\n"
    header += b"property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\n"
    header += b"end_header\n"
    (tmp_path / "a.ply").write_bytes(header + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    code = "import sys; from learn3d.data import meshes; from pathlib import Path; meshes.read_mesh(Path(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(tmp_path / "a.ply")]  # pytest has a handler of its own
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[3])
    assert done.stdout + done.stderr == ""


def test_a_material_without_an_image_is_of_one_colour(tmp_path):
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "a.glb")
    assert has_colours(meshes.read_mesh(tmp_path / "a.glb"))


def test_folders_within_folders(tmp_path):
    path = tmp_path.joinpath(*["d"] * 400)
    path.mkdir(parents=True)
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(len(inspect.stack()) + 200)
    try:
        with pytest.raises(ValueError, match=r"no mesh file|nested too deeply"):  # which one is up to Python's version
            meshes.folder_sources(tmp_path)
    finally:
        sys.setrecursionlimit(before)


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
