"""Random meshes, written in every format by writers of their own and by trimesh, come back with the same triangles.

MESHES=2000 in the environment makes more of them than the usual few.
"""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from gltf_files import Arrays, glb

from learn3d.files.formats import read_mesh
from learn3d.files.reading import FETCH_AGAIN, DamagedFile

MESHES = int(os.environ.get("MESHES", "12"))
Parts = list[tuple[np.ndarray, list[list[int]]]]  # vertices [V, 3] and polygons of each part


def random_parts(rng: np.random.Generator, polygons: bool) -> Parts:
    """Up to three parts with shared corners; polygons of up to 9 corners, star-shaped and mostly concave, in planes."""
    parts = []
    for _ in range(rng.integers(1, 4)):
        vertices = [rng.normal(size=(5, 3))]
        faces = [rng.permutation(5)[:3].tolist() for _ in range(rng.integers(1, 9))]
        for _ in range(rng.integers(1, 4) if polygons else 0):
            size, first = int(rng.integers(4, 10)), sum(map(len, vertices))
            turns = 2 * np.pi * (np.arange(size) + rng.uniform(0, 0.5, size)) / size
            flat = rng.uniform(0.3, 1, (size, 1)) * np.stack(
                [np.cos(turns), np.sin(turns), 0 * turns], axis=1
            )
            vertices.append(flat @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + rng.normal(size=3))
            faces.append(list(range(first, first + size)))
        order = rng.permutation(len(faces))
        scale = 10 ** rng.uniform(-2, 2)
        parts.append((np.round(scale * np.concatenate(vertices), 6), [faces[i] for i in order]))
    return parts


def joined(parts: Parts) -> tuple[np.ndarray, list[list[int]]]:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    polygons = [
        [i + int(start) for i in one]
        for (_, faces), start in zip(parts, starts, strict=False)
        for one in faces
    ]
    return np.concatenate([vertices for vertices, _ in parts]), polygons


def write_obj(path: Path, parts: Parts, rng: np.random.Generator) -> None:
    lines, total, relative = ["# größe"], 0, rng.random() < 0.5
    gap = rng.choice([" ", "\t", "  "])
    for k, (vertices, polygons) in enumerate(parts):
        lines.append(f"o part {k}")
        lines += ["v" + gap + gap.join(map(repr, row)) for row in vertices.tolist()]
        first = -len(vertices) if relative else total + 1
        total += len(vertices)
        for one in polygons:
            form = rng.choice(["{}", "{}//1", "{}//"])
            words = [form.format(first + i) for i in one]
            lines.append(gap.join(["f", *words]) + rng.choice(["", " # x", " \\\n"]))
    path.write_bytes(rng.choice(["\n", "\r\n"]).join(lines).encode("latin-1"))


def write_off(path: Path, parts: Parts, rng: np.random.Generator) -> None:
    """With or without colours, or plain and without lines."""
    vertices, polygons = joined(parts)
    kind = rng.choice(["OFF", "COFF", "off"])
    color, gray = (" 255 0 0 255", " 0.5 0.5 0.5") if kind == "COFF" else ("", "")
    rows = [" ".join(map(repr, row)) + color for row in vertices.tolist()]
    rows += [" ".join(map(str, [len(one), *one])) + gray for one in polygons]
    head = f"{kind}{rng.choice([' ', chr(10)])}{len(vertices)} {len(polygons)} 0"
    text = " ".join([head, *rows]) if kind == "off" else "\n\n".join([head, "# größe", *rows])
    path.write_text(text, "latin-1")


def write_ply(path: Path, parts: Parts, rng: np.random.Generator) -> None:
    vertices, polygons = joined(parts)
    kinds = [("ascii", ""), ("binary_little_endian", "<"), ("binary_big_endian", ">")]
    kind, order = kinds[rng.integers(3)]
    count_type, count_code = [("uchar", "B"), ("int", "i"), ("ushort", "H")][rng.integers(3)]
    with_uv = rng.random() < 0.5
    head = [
        f"ply\nformat {kind} 1.0\ncomment Größe",
        f"element vertex {len(vertices)}\nproperty uchar red",
        "property double x\nproperty double y\nproperty double z",
        f"element face {len(polygons)}",
        *["property list uchar float texcoord"] * with_uv,
        f"property list {count_type} int vertex_indices\nend_header\n",
    ]
    body = [[("B", 7), *(("d", x) for x in row)] for row in vertices.tolist()]
    for one in polygons:
        uv = [("B", 2 * len(one)), *[("f", 0.5)] * 2 * len(one)] if with_uv else []
        body.append([*uv, (count_code, len(one)), *(("i", i) for i in one)])
    if kind == "ascii":
        content = "\n".join(" ".join(repr(value) for _, value in row) for row in body).encode()
    else:
        content = b"".join(struct.pack(order + code, value) for row in body for code, value in row)
    path.write_bytes("\n".join(head).encode("latin-1") + content)


def write_stl(path: Path, parts: Parts, rng: np.random.Generator) -> None:
    vertices, triangles = joined(parts)
    corners = vertices[np.array(triangles)].astype("<f4")
    if rng.random() < 0.5:
        rows = b"".join(bytes(12) + one.tobytes() + bytes(2) for one in corners)
        head = b"solid b".ljust(80) + struct.pack("<I", len(corners))
        path.write_bytes(head + rows + b"\n" * rng.integers(2))
        return
    lines = ["solid Größe"]
    for one in corners:
        rows = ["vertex " + " ".join(f"{x:.9g}" for x in row) for row in one]
        lines += ["facet normal 0 0 0\nouter loop", *rows, "endloop\nendfacet"]
    path.write_text("\n".join([*lines, "endsolid"]), "latin-1")


def write_gltf(path: Path, parts: Parts, rng: np.random.Generator) -> None:
    """A part is a mesh of a node, whose parent turns and scales; its triangles are a list, strips or fans."""
    arrays, meshes, nodes = Arrays(), [], []
    # 16 bits are too few for a small mesh that is moved so far
    small = np.abs(joined(parts)[0]).max() < 5
    for vertices, triangles in parts:
        turn, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = 2 * turn, shift
        local = ((vertices - shift) @ turn / 2 + [1, 2, 3]) / [2, 1, -1]
        scale, rows = 1.0, local.astype("<f4")
        storage = "floats" if small else rng.choice(["floats", "sparse", "quantized"])
        if storage == "quantized":
            scale = np.abs(local).max()
            rows = np.pad(np.round(local / scale * 32767), ((0, 0), (0, 1))).astype("<i2")
            position = arrays.add(rows, type="VEC3", normalized=True)
            arrays.views[position]["byteStride"] = 8
        elif storage == "floats":
            position = arrays.add(rows)
        else:
            position = arrays.add(0 * rows)
            which, values = arrays.add(np.arange(len(rows), dtype="<u2")), arrays.add(rows)
            arrays.accessors[position]["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": which, "componentType": 5123},
                "values": {"bufferView": values},
            }
        mode = int(rng.integers(4, 7))
        primitive = {"attributes": {"POSITION": position}}
        primitives = [primitive | {"mode": 0}]  # points
        for group in [np.ravel(triangles)] if mode == 4 else triangles:
            indices = arrays.add(np.array(group, "<u2"))
            primitives.append(primitive | {"indices": indices, "mode": mode})
        place = {"translation": [-1, -2, -3], "scale": (scale * np.array([2, 1, -1])).tolist()}
        nodes.append({"matrix": matrix.T.ravel().tolist(), "children": [len(nodes) + 1]})
        nodes.append({"mesh": len(meshes)} | place)
        meshes.append({"primitives": primitives})
    tree = {
        "asset": {"version": "2.0"},
        "extensionsRequired": ["KHR_mesh_quantization"],
        "scene": 1,
        "scenes": [{"nodes": []}, {"nodes": [*range(0, len(nodes), 2)]}],
        "nodes": nodes,
        "meshes": meshes,
    }
    if path.suffix == ".gltf":
        path.write_text(json.dumps(tree | arrays.tree(embedded=True)))
    else:
        path.write_bytes(glb(tree | arrays.tree(embedded=False), arrays.content))


def write_trimesh(path: Path, parts: Parts, rng: np.random.Generator) -> None:
    scene = trimesh.Scene()
    for vertices, triangles in parts:
        matrix = trimesh.transformations.random_rotation_matrix(rng.random(3))
        matrix[:3, 3] = rng.normal(size=3)
        local = (vertices - matrix[:3, 3]) @ matrix[:3, :3]
        scene.add_geometry(trimesh.Trimesh(local, triangles, process=False), transform=matrix)
    if path.suffix == ".gltf":
        for name, content in scene.export(file_type="gltf").items():
            (path if name == "model.gltf" else path.parent / name).write_bytes(content)
    elif path.suffix in (".glb", ".obj"):
        scene.export(path)
    else:
        options = {"encoding": rng.choice(["ascii", "binary"])} if path.suffix == ".ply" else {}
        scene.to_mesh().export(path, **options)


WRITERS = {  # name of the file: writer, whether it takes polygons
    "own.obj": (write_obj, True),
    "own.off": (write_off, True),
    "own.ply": (write_ply, True),
    "own.stl": (write_stl, False),
    "own.glb": (write_gltf, False),
    "own.gltf": (write_gltf, False),
    **{
        f"trimesh.{kind}": (write_trimesh, False)
        for kind in ("obj", "off", "ply", "stl", "glb", "gltf")
    },
}


def area_vectors(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def compare(parts: Parts, corners: np.ndarray) -> None:
    """Compare triangles [F, 3, 3] with the parts: triangles as a set, polygons by their areas."""
    vertices, polygons = joined(parts)
    scale, used = np.abs(vertices).max(), np.zeros(len(corners), bool)
    assert len(corners) == sum(len(one) - 2 for one in polygons)
    for one in polygons:
        points = vertices[one]
        # to its nearest corner
        distance = np.abs(corners[:, :, None] - points).max(axis=3).min(axis=2).max(axis=1)
        inside = np.flatnonzero((distance < 2e-4 * scale) & ~used)[: len(one) - 2]
        assert len(inside) == len(one) - 2
        used[inside] = True
        whole = np.cross(points - points[0], np.roll(points - points[0], -1, axis=0)).sum(axis=0)
        parts_of = np.linalg.norm(area_vectors(corners[inside]), axis=1).sum()
        assert parts_of == pytest.approx(np.linalg.norm(whole), rel=2e-2, abs=1e-3 * scale**2)
    assert used.all()


@pytest.mark.parametrize("name", WRITERS)
def test_random_meshes_come_back(tmp_path: Path, name: str) -> None:
    write, polygons = WRITERS[name]
    rng = np.random.default_rng(sum(name.encode()))
    for _ in range(MESHES):
        parts = random_parts(rng, polygons)
        write(tmp_path / name, parts, rng)
        mesh = read_mesh(tmp_path / name)
        compare(parts, mesh.vertices[mesh.faces])


def made(folder: Path, name: str) -> bytes:
    write, polygons = WRITERS[name]
    rng = np.random.default_rng(3)
    write(folder / name, random_parts(rng, polygons), rng)
    return (folder / name).read_bytes()


@pytest.mark.parametrize(
    "name", ["own.off", "own.ply", "own.stl", "own.glb", "own.gltf", "trimesh.ply", "trimesh.stl"]
)
def test_files_that_are_cut_short_say_so(tmp_path: Path, name: str) -> None:
    content = made(tmp_path, name)
    for share in (0, 0.3, 0.6, 0.95):
        (tmp_path / name).write_bytes(content[: int(share * len(content))])
        with pytest.raises(
            DamagedFile, match=rf"{name}: cannot be read \(.*; expected a mesh file. {FETCH_AGAIN}"
        ):
            read_mesh(tmp_path / name)


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
