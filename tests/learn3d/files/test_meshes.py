"""Untrusted mesh files: what they refer to, and what they are made of."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from learn3d.files.meshes import EXTENSIONS, RawMesh, read_mesh

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
LATIN = "größe".encode("latin-1")


def textured(folder: Path, texture: str) -> Path:
    """An OBJ file that names a texture."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "a.mtl").write_text(f"newmtl m\nmap_Kd {texture}\n")
    (folder / "a.obj").write_text("mtllib a.mtl\n" + TRIANGLE)
    return folder / "a.obj"


def red(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (4, 4), (255, 0, 0)).save(path)
    return path


def is_red(mesh: RawMesh) -> bool:
    return bool(np.allclose(mesh.face_colors, [1, 0, 0], atol=0.02))


def test_files_that_a_mesh_refers_to_come_from_the_source_folder_only(tmp_path):
    source = tmp_path / "source"
    red(source / "images" / "t.png")
    red(tmp_path / "secret.png")
    inside = textured(source / "models", "../images/t.png")  # as in ShapeNet
    assert is_red(read_mesh(inside, source))
    assert not is_red(read_mesh(inside))  # its own folder alone
    for name in ("../../secret.png", str(tmp_path / "secret.png")):
        mesh = read_mesh(textured(source / "models", name), source)
        assert len(mesh.faces) == 1 and not is_red(mesh)
    (source / "link.png").symlink_to(tmp_path / "secret.png")
    assert not is_red(read_mesh(textured(source, "link.png"), source))
    (tmp_path / "link.obj").symlink_to(inside)  # the mesh itself may be a link
    assert len(read_mesh(tmp_path / "link.obj").faces) == 1


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n%%EOF\n"


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_textures_run_no_programs(tmp_path, kind):
    """Ghostscript is played by a shell script."""
    ran, program = tmp_path / "ran", tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {ran}\n")
    program.chmod(0o755)
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
    code = "import sys; from pathlib import Path; from learn3d.files.meshes import read_mesh\n"
    command = [sys.executable, "-c", code + "print(len(read_mesh(Path(sys.argv[1])).faces))", str(path)]
    environment = os.environ | {"PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "1\n" and done.stderr == "" and not ran.exists()


@pytest.mark.parametrize("kind", ["png", "tga", "gif", "ppm", "bmp", "webp"])
def test_textures_of_the_usual_formats_are_read(tmp_path, kind):
    path = red(tmp_path / f"t.{kind}")
    assert is_red(read_mesh(textured(tmp_path, path.name)))
    path.write_bytes(path.read_bytes()[:50])  # a texture that cannot be read does not cost the mesh
    assert len(read_mesh(textured(tmp_path, path.name)).faces) == 1


def test_a_material_without_an_image_is_of_one_colour(tmp_path):
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[255, 0, 0, 255])
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    box.export(tmp_path / "a.glb")
    assert is_red(read_mesh(tmp_path / "a.glb"))


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


@pytest.mark.parametrize("kind", EXTENSIONS[:4])
def test_a_letter_that_is_not_utf8_costs_nothing(tmp_path, kind):
    box = trimesh.creation.box()
    if kind == ".stl":
        content = trimesh.exchange.stl.export_stl_ascii(box).encode().replace(b"solid", b"solid " + LATIN, 1)
    elif kind == ".ply":
        content = box.export(file_type="ply", encoding="ascii")
        content = content.replace(b"format ascii 1.0\n", b"format ascii 1.0\ncomment " + LATIN + b"\n")
    else:
        content = box.export(file_type=kind[1:]).encode().replace(b"\n", b"\n# " + LATIN + b"\n", 1)
    (tmp_path / f"a{kind}").write_bytes(content)
    assert LATIN in content and len(read_mesh(tmp_path / f"a{kind}").faces) == 12


def test_names_of_materials_in_latin_1(tmp_path):
    path = textured(tmp_path, "t.png")
    red(tmp_path / "t.png")
    for file in (path, path.with_suffix(".mtl")):
        file.write_bytes(file.read_bytes().replace(b"mtl m", b"mtl " + LATIN))
    assert is_red(read_mesh(path))


def test_files_that_are_none(tmp_path):
    with pytest.raises(ValueError, match="is missing"):
        read_mesh(tmp_path / "a.off")
    (tmp_path / "a.off").write_text("OFF\n8 12 0\n")
    with pytest.raises(ValueError, match="cannot be read"):
        read_mesh(tmp_path / "a.off")
