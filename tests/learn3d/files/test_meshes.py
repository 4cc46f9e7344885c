"""Mesh files that somebody else may have made: what they refer to, and what they are made of."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import EpsImagePlugin, Image

from learn3d.files.meshes import EXTENSIONS, RawMesh, read_mesh

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


def has_colours(mesh: RawMesh) -> bool:
    return bool(np.allclose(mesh.face_colors, [1, 0, 0], atol=0.02))


def test_files_that_a_mesh_refers_to_come_from_the_source_folder_only(tmp_path):
    source = tmp_path / "source"
    red(source / "images" / "t.png")
    red(tmp_path / "secret.png")
    inside = textured(source / "models", "../images/t.png")  # as in ShapeNet
    assert has_colours(read_mesh(inside, source))
    assert not has_colours(read_mesh(inside))  # its own folder alone
    for name in ("../../secret.png", str(tmp_path / "secret.png")):
        mesh = read_mesh(textured(source / "models", name), source)
        assert len(mesh.faces) == 1 and not has_colours(mesh)
    (source / "link.png").symlink_to(tmp_path / "secret.png")
    assert not has_colours(read_mesh(textured(source, "link.png"), source))


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
    mesh = read_mesh(path)
    assert len(mesh.faces) == 1 and not has_colours(mesh) and not ran.exists()


@pytest.mark.parametrize("kind", ["png", "tga", "gif", "ppm", "bmp", "webp"])
def test_textures_of_the_usual_formats_are_read(tmp_path, kind):
    red(tmp_path / f"t.{kind}")
    assert has_colours(read_mesh(textured(tmp_path, f"t.{kind}")))


def test_a_texture_that_cannot_be_read_does_not_cost_the_mesh(tmp_path):
    path = red(tmp_path / "t.png")
    path.write_bytes(path.read_bytes()[:50])
    mesh = read_mesh(textured(tmp_path, "t.png"))
    assert len(mesh.faces) == 1 and not has_colours(mesh)


def test_what_trimesh_passes_over_is_not_printed(tmp_path):
    header = b"ply\nformat ascii 1.0\ncomment TextureFile \x1b[2J.png\nelement vertex 3\nproperty float x\n"
    header += b"property float y\nproperty float z\nelement face 1\nproperty list uchar int vertex_indices\n"
    header += b"end_header\n"
    (tmp_path / "a.ply").write_bytes(header + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    code = (
        "import sys; from learn3d.files.meshes import read_mesh; from pathlib import Path; read_mesh(Path(sys.argv[1]))"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a.ply")]  # pytest has a handler of its own
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[3])
    assert done.stdout + done.stderr == ""


def test_a_material_without_an_image_is_of_one_colour(tmp_path):
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "a.glb")
    assert has_colours(read_mesh(tmp_path / "a.glb"))


def test_buffers_from_elsewhere_are_refused(tmp_path):
    (tmp_path / "in").mkdir()
    for name, content in trimesh.Scene(trimesh.creation.box()).export(file_type="gltf").items():
        (tmp_path / "in" / name).write_bytes(content)
    assert len(read_mesh(tmp_path / "in" / "model.gltf").faces) == 12
    model = json.loads((tmp_path / "in" / "model.gltf").read_text())
    for buffer in model["buffers"]:
        (tmp_path / "in" / buffer["uri"]).rename(tmp_path / buffer["uri"])
        buffer["uri"] = "../" + buffer["uri"]
    (tmp_path / "in" / "model.gltf").write_text(json.dumps(model))
    with pytest.raises(ValueError, match="outside of"):
        read_mesh(tmp_path / "in" / "model.gltf")


LATIN = "größe".encode("latin-1")


@pytest.mark.parametrize("kind", EXTENSIONS[:4])
def test_a_letter_that_is_not_utf8_costs_nothing(tmp_path, kind):
    path = tmp_path / f"a{kind}"
    content = trimesh.creation.box().export(file_type=kind[1:], **({"encoding": "ascii"} if kind == ".ply" else {}))
    content = content if isinstance(content, bytes) else content.encode()
    if kind in (".obj", ".off"):
        content = content.replace(b"\n", b"\n# " + LATIN + b"\n", 1)
    elif kind == ".ply":
        content = content.replace(b"format ascii 1.0\n", b"format ascii 1.0\ncomment " + LATIN + b"\n")
    else:
        content = trimesh.exchange.stl.export_stl_ascii(trimesh.creation.box()).encode()
        content = content.replace(b"solid", b"solid " + LATIN, 1)
    path.write_bytes(content)
    assert LATIN in path.read_bytes() and len(read_mesh(path).faces) == 12


def test_names_of_materials_in_latin_1(tmp_path):
    path = textured(tmp_path, "t.png")
    red(tmp_path / "t.png")
    for file in (path, path.with_suffix(".mtl")):
        file.write_bytes(file.read_bytes().replace(b"mtl m", b"mtl " + LATIN))
    assert has_colours(read_mesh(path))


def test_files_that_are_none(tmp_path):
    with pytest.raises(ValueError, match="is missing"):
        read_mesh(tmp_path / "a.off")
    (tmp_path / "a.off").write_text("OFF\n8 12 0\n")
    with pytest.raises(ValueError, match="cannot be read"):
        read_mesh(tmp_path / "a.off")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "b.off")
        with pytest.raises(ValueError, match="no plain file"):
            read_mesh(tmp_path / "b.off")
