"""Untrusted mesh files: other files that they refer to."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest
import trimesh
from PIL import Image

from learn3d.files.meshes import read_mesh

TRIANGLE = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n%%EOF\n"


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_textures_run_no_programs(tmp_path, kind):
    """Ghostscript is played by a shell script."""
    ran, program = tmp_path / "ran", tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {ran}\n")
    program.chmod(0o755)
    path, texture = tmp_path / "a.obj", tmp_path / "t.png"
    path.write_text(TRIANGLE)
    path.with_suffix(".mtl").write_text("newmtl m\nmap_Kd t.png\n")
    Image.new("RGB", (4, 4), (255, 0, 0)).save(texture)
    if kind == "glb":
        content = trimesh.load(path, force="scene", process=False).export(file_type="glb")
        start = content.index(b"\x89PNG")
        length = content.index(b"IEND") + 8 - start
        path = path.with_suffix(".glb")
        path.write_bytes(content[:start] + EPS.ljust(length) + content[start + length :])
    texture.write_bytes(EPS)
    code = "import sys; from pathlib import Path; from learn3d.files.meshes import read_mesh\n"
    command = [sys.executable, "-c", code + "print(len(read_mesh(Path(sys.argv[1])).faces))", str(path)]
    environment = os.environ | {"PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "1\n" and done.stderr == "" and not ran.exists()


def test_buffers_from_elsewhere_are_refused(tmp_path):
    (tmp_path / "in").mkdir()
    for name, content in trimesh.Scene(trimesh.creation.box()).export(file_type="gltf").items():
        (tmp_path / "in" / name).write_bytes(content)
    path = tmp_path / "in" / "model.gltf"
    assert len(read_mesh(path).faces) == 12
    model = json.loads(path.read_text())
    for buffer in model["buffers"]:
        (tmp_path / "in" / buffer["uri"]).rename(tmp_path / buffer["uri"])
    with pytest.raises(ValueError, match="is missing"):
        read_mesh(path)
    for buffer in model["buffers"]:
        buffer["uri"] = "../" + buffer["uri"]
    path.write_text(json.dumps(model))
    with pytest.raises(ValueError, match="outside of"):
        read_mesh(path)


@pytest.mark.parametrize("kind", ["obj", "off"])
def test_a_letter_that_is_not_utf8_costs_nothing(tmp_path, kind):
    content = trimesh.creation.box().export(file_type=kind).encode()
    (tmp_path / f"a.{kind}").write_bytes(content.replace(b"\n", b"\n# " + "größe".encode("latin-1") + b"\n", 1))
    assert len(read_mesh(tmp_path / f"a.{kind}").faces) == 12


def test_files_that_are_none(tmp_path):
    with pytest.raises(ValueError, match="is missing"):
        read_mesh(tmp_path / "a.off")
    (tmp_path / "a.off").write_text("OFF\n8 12 0\n")
    with pytest.raises(ValueError, match="cannot be read"):
        read_mesh(tmp_path / "a.off")
