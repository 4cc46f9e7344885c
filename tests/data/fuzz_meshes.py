"""What is fuzzed, part 2: mesh files, packs of them, Debian packages, and the OBJ reader of the drop-in."""

from __future__ import annotations

import contextlib
import gzip
import io
import random
import tarfile
import zipfile
from pathlib import Path

import mutations as m
import numpy as np
import trimesh
from mutations import Target
from PIL import Image

import nmr.neural_renderer as nr
from learn3d.make_data import meshes
from learn3d.make_data.debian import mesh_text, packages
from learn3d.make_data.debian.furniture import CATALOGUE, furniture_models
from learn3d.make_data.debian.mesh_cleaning import clean_mesh


def mesh_target(tmp: Path) -> Target:
    folder = tmp / "formats"
    (folder / "sub").mkdir(parents=True)
    box = trimesh.creation.icosphere(1)
    box.visual.vertex_colors = np.arange(4 * len(box.vertices)).reshape(-1, 4) % 256
    scene = trimesh.Scene([box, trimesh.creation.box(transform=trimesh.transformations.translation_matrix([1, 2, 3]))])
    for name in ("a.off", "a.ply", "a.stl", "a.glb"):
        (scene if name == "a.glb" else box).export(folder / name)
    box.export(folder / "b.ply", encoding="ascii")
    (folder / "a.obj").write_text(OBJ)
    (folder / "a.mtl").write_text(MTL)
    Image.new("RGB", (4, 4), (200, 10, 10)).save(folder / "a.png")
    for name, content in scene.export(file_type="gltf").items():
        (folder / name).write_bytes(content)
    chosen = dict.fromkeys([p.name for p in folder.iterdir() if p.suffix in (".stl", ".glb", ".bin", ".ply")], m.damage)
    chosen |= dict.fromkeys(["a.off", "b.ply", "a.obj", "a.mtl"], m.damage_text) | {"a.png": m.damage_png}
    chosen |= {"model.gltf": m.damage_json}

    def read(folder: Path) -> None:
        for source in meshes.folder_sources(folder)[0]:
            with contextlib.suppress(ValueError):
                checked = meshes.checked(source.read(), 10_000)
                assert np.isfinite(checked.vertices).all() and checked.faces.max() < len(checked.vertices)

    return Target(folder, chosen, read)


OBJ = """mtllib a.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0.5
v 0.5 0.5 2
vt 0 0
vt 1 0
vt 1 1
usemtl red
f 1/1 2/2 3/3 4/1
usemtl blue
f 1/1 2/2 5/3
f 2//1 3//1 5//1
f -5 -4 -3 -2 -1
"""
MTL = "newmtl red\nKd 1 0 0\nmap_Kd a.png\nnewmtl blue\nKd 0 0 1\n"
AC3D = """AC3Db
MATERIAL "" rgb 1 1 1
OBJECT world
kids 2
OBJECT poly
name "fuselage"
data 4
abcd
loc 1 2 3
rot 1 0 0 0 1 0 0 0 1
numvert 5
0 0 0
1 0 0
1 1 0
0 1 0
0.5 0.5 2
numsurf 3
SURF 0x10
mat 0
refs 4
0 0 0
1 0 0
2 0 0
3 0 0
SURF 0x20
refs 5
0 0 0
1 0 0
2 0 0
3 0 0
4 0 0
SURF 0x10
refs 3
0 0 0
1 0 0
4 0 0
kids 1
OBJECT poly
numvert 3
0 0 0
1 0 0
0 1 0
numsurf 1
SURF 0x10
refs 3
0 0 0
1 0 0
2 0 0
kids 0
OBJECT poly
kids 0
"""


def mesh_text_target(tmp: Path) -> Target:
    folder = tmp / "text"
    folder.mkdir()
    (folder / "a.obj").write_text(OBJ)
    (folder / "a.ac").write_text(AC3D)

    def read(folder: Path) -> None:
        for parts in (
            [mesh_text.read_obj((folder / "a.obj").read_text("latin-1"))],
            [(p.vertices, p.faces) for p in mesh_text.read_ac3d((folder / "a.ac").read_text("latin-1"))],
        ):
            for vertices, faces in parts:
                assert not len(faces) or 0 <= faces.min() <= faces.max() < len(vertices)
                with contextlib.suppress(ValueError):
                    clean_mesh(vertices, faces)

    return Target(folder, {"a.obj": m.damage_text, "a.ac": m.damage_text}, read)


def pack_target(tmp: Path) -> Target:
    box = trimesh.creation.box()
    np.savez(tmp / "pack.npz", n=2, v0=box.vertices, f0=box.faces, v1=box.vertices, f1=box.faces)

    def read(folder: Path) -> None:
        for source in meshes.pack_sources(folder / "pack.npz"):
            with contextlib.suppress(ValueError):
                meshes.checked(source.read(), 10_000)

    return Target(tmp, {"pack.npz": m.damage_zip(m.damage_npy)}, read)


def catalogue_bytes() -> bytes:
    out, lines = io.BytesIO(), ["id=Test", "license=Free"]
    for number in (1, 2):
        lines += [f"name#{number}=Oak chair", f"category#{number}=Living", f"model#{number}=/m/a.obj"]
        lines += [f"width#{number}=4", f"height#{number}=4", f"depth#{number}=4", f"creator#{number}=A\\u00e9"]
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(CATALOGUE, "\n".join(lines) + "\nmodelRotation#2=1 0 0 0 1 0 0 0 1\n")
        archive.writestr("m/a.obj", OBJ)
    return out.getvalue()


def deb_bytes(files: dict[str, bytes], kind: str = "xz") -> bytes:
    """A Debian package of these files."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode=f"w:{kind}") as tar:
        for path, content in files.items():
            info = tarfile.TarInfo(path)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    out = bytearray(b"!<arch>\n")
    members = {"debian-binary": b"2.0\n", "control.tar.xz": b"odd", f"data.tar.{kind}": data.getvalue()}
    for name, content in members.items():
        out += f"{name:<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{len(content):<10}`\n".encode()
        out += content + b"\n" * (len(content) % 2)
    return bytes(out)


def damage_deb(rng: random.Random, content: bytes) -> bytes:
    """The catalogue in it, the tar archive under its compression, or plain damage."""
    kind = rng.random()
    if kind < 0.3:
        return m.damage(rng, content)
    sh3f, name = catalogue_bytes(), "usr/share/x.sh3f"
    if kind < 0.6:
        return deb_bytes({name: m.damage_zip(m.damage_text)(rng, sh3f)}, rng.choice(["xz", "gz", "bz2"]))
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as tar:
        info = tarfile.TarInfo(rng.choice([name, "n" * 300, "../x", "/x"]))
        info.size = len(sh3f)
        tar.addfile(info, io.BytesIO(sh3f))
    packed = gzip.compress(m.damage(rng, data.getvalue()))
    start = content.index(b"data.tar")
    head = f"{'data.tar.gz':<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{len(packed):<10}`\n".encode()
    return content[:start] + head + packed


def debian_target(tmp: Path) -> Target:
    path = tmp / "sweethome3d-furniture_1_all.deb"
    path.write_bytes(deb_bytes({"usr/share/x.sh3f": catalogue_bytes()}))

    def read(folder: Path) -> None:
        package = packages.find_package("sweethome3d-furniture", folder)
        for candidate in furniture_models(package, ("chair",), folder / "licences", False):
            if candidate is not None:
                candidate.title.encode()
                with contextlib.suppress(ValueError):
                    clean_mesh(*candidate.read())

    return Target(tmp, {path.name: damage_deb}, read)


def drop_in_target(tmp: Path) -> Target:
    (tmp / "a.obj").write_text(OBJ)
    (tmp / "a.mtl").write_text(MTL)
    Image.new("RGB", (4, 4), (200, 10, 10)).save(tmp / "a.png")

    def read(folder: Path) -> None:
        for bilinear in (True, False):
            vertices, faces, textures = nr.load_obj(
                folder / "a.obj", load_texture=True, texture_size=2, use_bilinear=bilinear
            )
            assert 0 <= faces.min() <= faces.max() < len(vertices) and len(textures) == len(faces)
            assert vertices.isfinite().all() and textures.isfinite().all()

    return Target(tmp, {"a.obj": m.damage_text, "a.mtl": m.damage_text, "a.png": m.damage_png}, read)
