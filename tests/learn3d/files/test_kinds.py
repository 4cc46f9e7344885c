"""What programs write in each format, as a table, and random meshes over it, of our own and trimesh's writers.

The same triangles must come back. FILES=5000 in the environment makes more of them than the usual few.
"""

from __future__ import annotations

import base64
import json
import os
import struct
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
import trimesh
from gltf_files import Arrays, glb

from learn3d.files.formats import read_mesh
from learn3d.files.reading import FETCH_AGAIN, DamagedFile

FILES = int(os.environ.get("FILES", "150"))
Parts = list[tuple[np.ndarray, list[list[int]]]]  # vertices [V, 3] and polygons of each part
Choice = dict[str, object]
#: For each format, what its files differ in. Sources: the programs named behind `#`, and reports about other readers.
KINDS: dict[str, dict[str, list]] = {
    "text.stl": {
        "mark": ["", "\ufeff"],  # Windows editors
        "before": ["", "\n\n  "],
        "name": ["", " x", " vertex_block", " facet", " endsolid 2", " Exported vertex count 6",
                 " " + "long " * 40, " größe"],
        "end": ["endsolid{name}", "endsolid", "end solid{name}", "ENDSOLID"],  # CATIA's two words
        "number": ["{:.9g}", "{:e}", "{:+.9E}", "{:.6f}"],
        "gap": [" ", "\t", "   "],
        "line": ["\n", "\r\n", "\r", " "],  # all in a line
        "case": [str, str.upper],
        "facet_end": ["endfacet", "end facet"],
        "solids": [1, 2],
        "tail": ["", "\n", "\n\n "],
    },
    "binary.stl": {
        "head": [b"", b"solid made by a program", b"solid facet of the part", b"solid endsolid", b"COLOR=\1\2\3\4"],
        "fill": [b"\0", b" "],
        "count": ["right", 0, 2**32 - 1],  # written to a stream
        "attribute": [b"\0\0", b"\x1f\x80"],  # Materialise's colours
        "tail": [b"", b"\0", b"\n" * 7],
    },
    "a.off": {
        "mark": ["", "\ufeff"],
        "before": ["", "# a comment\n", "\n\n"],
        "head": ["OFF", "off", "COFF", "NOFF", "CNOFF", "STOFF"],  # Geomview
        "glue": ["", " ", "\n", "\n# counts\n\n"],  # ModelNet40 has none
        "edges": [" 0", " 5", ""],  # MeshLab, CGAL, few have none
        "face": ["{}", "{} 255 0 0", "{} 0.5 0.5 0.5 1", "{}  # face"],
        "gap": [" ", "\t"],
        "line": ["\n", "\r\n", "\r"],
        "blank": ["", "\n", "# c\n"],
        "plain": [False, False, False, True],  # all in a line
        "tail": ["", "\n\n"],
    },
    "a.ply": {
        "mark": ["", "\ufeff"],
        "format": ["ascii", "binary_little_endian", "binary_big_endian"],
        "line": ["\n", "\r\n"],
        "comment": ["", "comment größe\n", "obj_info 3 4\n"],
        "type": ["float", "double", "float32"],
        "first": ["", "red"],
        "more": ["", "nx"],
        "list": ["uchar int vertex_indices", "uint8 int32 vertex_index", "int uint vertex_indices",
                 "uchar ushort vertex_index", "ushort int vertex_indices"],
        "extra": ["", "edge"],
        "uv": [False, True],
    },
    "a.obj": {
        "mark": ["", "\ufeff"],
        "head": ["", "# Blender\n", "mtllib a b.mtl\n", "g\n", "o größe\n"],
        "number": ["{:.6f}", "{:.9g}", "{:+e}"],
        "gap": [" ", "\t", "  "],
        "color": ["", " 0.5 0.5 0.5", " 1.0"],
        "between": ["", "vn 0 0 1\nvt 0 0\n", "vt 0 0 0\n", "s off\nusemtl a#b\n", "l 1 2\np 1\n"],
        "corner": ["{}", "{}/1", "{}//1", "{}/1/1", "{}//", "{}/"],
        "relative": [False, True],
        "indent": ["", "  "],
        "end": ["", " ", " # f 1 2 2"],
        "continued": [False, True],
        "line": ["\n", "\r\n", "\r"],
        "case": [str, str.upper],
        "tail": ["", "\n", "\0"],
    },
    "a.gltf": {
        "place": ["data", "encoded", "plain", "file", "blank", "percent", "backslash", "chunk"],
        "storage": ["floats", "sparse", "quantized"],
        "mode": [4, 5, 6],  # a list, strips, fans
        "compressed": [None, "KHR_draco_mesh_compression", "EXT_meshopt_compression"],
        "indices": [None, "<u2", "<u4"],
        "tail": ["", "\n", "  "],
    },
}  # fmt: skip


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


def corners(parts: Parts) -> np.ndarray:
    """Triangles float64 [F, 3, 3]."""
    vertices, triangles = joined(parts)
    return vertices[np.array(triangles)]


def text_stl(k: Choice, parts: Parts) -> bytes:
    lines = []
    for part in np.array_split(corners(parts), k["solids"]):
        lines.append(f"solid{k['name']}")
        for face in part:
            lines.append("facet normal 0 0 1\n outer loop")
            lines += ["vertex " + " ".join(map(k["number"].format, p)) for p in face.tolist()]
            lines += [" endloop", k["facet_end"]]
        lines.append(k["end"].format(name=k["name"]))
    text = k["case"]("\n".join(lines)).replace(" ", k["gap"]).replace("\n", k["line"])
    return (k["mark"] + k["before"] + text + k["tail"]).encode()


def binary_stl(k: Choice, parts: Parts) -> bytes:
    rows = [bytes(12) + face.tobytes() + k["attribute"] for face in corners(parts).astype("<f4")]
    count = len(rows) if k["count"] == "right" else k["count"]
    tail = k["tail"] if k["count"] == "right" else b""  # else the length tells the count
    return k["head"].ljust(80, k["fill"]) + struct.pack("<I", count) + b"".join(rows) + tail


def off(k: Choice, parts: Parts) -> bytes:
    after = {"COFF": " 255 0 0 255", "NOFF": " 0 0 1", "CNOFF": " 0 0 1 1 0 0 1", "STOFF": " 0 1"}
    vertices, polygons = joined(parts)
    places = [" ".join(map(repr, p)) for p in vertices.tolist()]
    faces = [" ".join(map(str, [len(one), *one])) for one in polygons]
    counts = f"{len(vertices)} {len(polygons)}"
    if k["plain"]:
        return " ".join(["OFF", counts, "0", *places, *faces]).encode()
    rows = [counts + k["edges"], *(place + after.get(k["head"], "") for place in places)]
    rows += map(k["face"].format, faces)
    text = k["before"] + k["head"] + k["glue"] + ("\n" + k["blank"]).join(rows) + k["tail"]
    return (k["mark"] + text.replace(" ", k["gap"]).replace("\n", k["line"])).encode()


def ply(k: Choice, parts: Parts) -> bytes:
    order = "<" if "little" in k["format"] else ">"
    codes = {"float": "f", "float32": "f", "double": "d", "uchar": "B", "uint8": "B"}
    codes |= {"int": "i", "int32": "i", "uint": "I", "ushort": "H"}
    count, index, name = k["list"].split()
    vertices, polygons = joined(parts)
    head = f"ply\nformat {k['format']} 1.0\n{k['comment']}element vertex {len(vertices)}\n"
    columns = [*["uchar red"] * bool(k["first"]), *(f"{k['type']} {axis}" for axis in "xyz")]
    head += "".join(f"property {c}\n" for c in [*columns, *["uchar nx"] * bool(k["more"])])
    head += f"element {k['extra']} 2\nproperty int vertex1\n" if k["extra"] else ""
    head += f"element face {len(polygons)}\n" + "property list uchar float texcoord\n" * k["uv"]
    head += f"property list {count} {index} {name}\nend_header\n"
    byte = [("B", 7)]
    rows = [
        byte * bool(k["first"]) + [(codes[k["type"]], x) for x in p] + byte * bool(k["more"])
        for p in vertices.tolist()
    ]
    rows += [[("i", 3)]] * 2 * bool(k["extra"])
    for one in polygons:
        uv = [("B", 2 * len(one)), *[("f", 0.5)] * 2 * len(one)] if k["uv"] else []
        rows.append([*uv, (codes[count], len(one)), *((codes[index], i) for i in one)])
    if k["format"] == "ascii":
        body = "".join(" ".join(str(x) for _, x in row) + k["line"] for row in rows).encode()
    else:
        body = b"".join(struct.pack(order + code, x) for row in rows for code, x in row)
    return (k["mark"] + head.replace("\n", k["line"])).encode() + body


def obj(k: Choice, parts: Parts) -> bytes:
    text, total = "vt 0 0\n", 0
    for vertices, polygons in parts:
        lines = [
            "v " + " ".join(map(k["number"].format, p)) + k["color"] for p in vertices.tolist()
        ]
        text += "\n".join(lines) + "\n" + k["between"]
        first = -len(vertices) if k["relative"] else total + 1
        total += len(vertices)
        for one in polygons:
            words = " ".join(k["corner"].format(first + i) for i in one)
            words = words.replace(" ", " \\\n" if k["continued"] else " ", 1)
            text += f"{k['indent']}f {words}{k['end']}\n"
    text = k["head"] + k["case"](text).replace(" ", k["gap"])
    return (k["mark"] + text + k["tail"]).replace("\n", k["line"]).encode()


def gltf(k: Choice, parts: Parts, folder: Path, rng: np.random.Generator) -> bytes:
    """A part is a mesh of a node, whose parent turns and scales."""
    arrays, meshes, nodes = Arrays(), [], []
    # 16 bits are too few for a small mesh that is moved so far
    storage = "floats" if np.abs(joined(parts)[0]).max() < 5 else k["storage"]
    for vertices, triangles in parts:
        turn, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = 2 * turn, shift
        local = ((vertices - shift) @ turn / 2 + [1, 2, 3]) / [2, 1, -1]
        if k["indices"] is None:
            local = local[np.ravel(triangles)]
        scale, rows = 1.0, local.astype("<f4")
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
        primitive = {"attributes": {"POSITION": position}}
        primitives = [primitive | {"mode": 0}]  # points
        if k["indices"] is None:
            primitives.append(primitive)
        else:
            for group in [np.ravel(triangles)] if k["mode"] == 4 else triangles:
                indices = arrays.add(np.array(group, k["indices"]))
                primitives.append(primitive | {"indices": indices, "mode": k["mode"]})
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
    tree |= arrays.tree(embedded=k["place"] != "chunk")
    if k["compressed"]:
        tree["extensionsUsed"] = [k["compressed"]]
        owner = meshes[0]["primitives"][1] if "draco" in k["compressed"] else tree["bufferViews"][0]
        owner["extensions"] = {k["compressed"]: {"bufferView": 0, "buffer": 0}}
    if k["place"] == "chunk":
        return glb(tree, arrays.content)
    names = {"file": "a.bin", "blank": "a b.bin", "percent": "a%20b.bin", "backslash": "c/d.bin"}
    name = names.get(k["place"])
    data = "data:application/octet-stream"
    uris = {
        "encoded": f"{data};base64,{quote(base64.b64encode(arrays.content).decode(), safe='')}",
        "plain": f"{data},{quote(bytes(arrays.content), safe='')}",
        "file": name,
        "blank": quote(name or ""),
        "percent": name,
        "backslash": "c\\d.bin",
    }
    if name:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(arrays.content)
    if k["place"] in uris:
        tree["buffers"][0]["uri"] = uris[k["place"]]
    return (json.dumps(tree) + k["tail"]).encode()


def write_by_trimesh(path: Path, parts: Parts, rng: np.random.Generator) -> None:
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


WRITERS = {"text.stl": text_stl, "binary.stl": binary_stl, "a.off": off, "a.ply": ply, "a.obj": obj}
POLYGONS = {"a.off", "a.ply", "a.obj"}


def choose(kinds: dict[str, list], rng: np.random.Generator) -> Choice:
    return {name: values[rng.integers(len(values))] for name, values in kinds.items()}


def write(name: str, folder: Path, rng: np.random.Generator) -> tuple[Choice, Path, Parts]:
    """A random file of a kind, or by trimesh."""
    parts = random_parts(rng, name in POLYGONS)
    if name not in KINDS:
        write_by_trimesh(folder / name, parts, rng)
        return {}, folder / name, parts
    kind = choose(KINDS[name], rng)
    content = WRITERS[name](kind, parts) if name in WRITERS else gltf(kind, parts, folder, rng)
    path = folder / ("a.glb" if kind.get("place") == "chunk" else name)
    path.write_bytes(content)
    return kind, path, parts


def area_vectors(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def compare(parts: Parts, corners: np.ndarray, near: float) -> None:
    """Compare triangles [F, 3, 3] with the parts: triangles as a set, polygons by their areas.

    near: largest distance of corners, as a share of the whole.
    """
    vertices, polygons = joined(parts)
    scale, used = np.abs(vertices).max(), np.zeros(len(corners), bool)
    assert len(corners) == sum(len(one) - 2 for one in polygons)
    for one in polygons:
        points = vertices[one]
        # to its nearest corner
        distance = np.abs(corners[:, :, None] - points).max(axis=3).min(axis=2).max(axis=1)
        inside = np.flatnonzero((distance < near * scale) & ~used)[: len(one) - 2]
        assert len(inside) == len(one) - 2
        used[inside] = True
        whole = np.cross(points - points[0], np.roll(points - points[0], -1, axis=0)).sum(axis=0)
        parts_of = np.linalg.norm(area_vectors(corners[inside]), axis=1).sum()
        assert parts_of == pytest.approx(np.linalg.norm(whole), rel=2e-2, abs=1e-3 * scale**2)
    assert used.all()


@pytest.mark.parametrize(
    "name", [*KINDS, *(f"trimesh.{kind}" for kind in ("obj", "off", "ply", "stl", "glb", "gltf"))]
)
def test_files_of_all_kinds_have_their_triangles(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(sum(name.encode()))
    for number in range(max(1, FILES // len(KINDS))):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        kind, path, parts = write(name, folder, rng)
        try:
            mesh = read_mesh(path)
            near = 2e-4 if "gl" in path.suffix else 2e-6  # float32, moved and turned
            compare(parts, mesh.vertices[mesh.faces], near)
        except (ValueError, AssertionError) as error:
            raise AssertionError(f"{path}: {kind}") from error


@pytest.mark.parametrize(
    "name", ["text.stl", "a.gltf", *(f"trimesh.{kind}" for kind in ("off", "ply", "stl", "glb"))]
)
def test_files_that_are_cut_short_say_so(tmp_path: Path, name: str) -> None:
    _, path, _ = write(name, tmp_path, np.random.default_rng(6))
    content = path.read_bytes()
    for share in (0, 0.3, 0.6, 0.95):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(
            DamagedFile,
            match=rf"{path.name}: cannot be read \(.*; expected a mesh file. {FETCH_AGAIN}",
        ):
            read_mesh(path)


def test_compressed_data_without_plain_data_are_named(tmp_path: Path) -> None:
    arrays = Arrays()
    arrays.add(np.zeros((3, 3), "<f4"))
    tree = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], **arrays.tree(embedded=False)}
    tree["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    tree["buffers"].append({"byteLength": 36})
    tree["bufferViews"][0]["buffer"] = 1
    (tmp_path / "a.glb").write_bytes(glb(tree, arrays.content))
    with pytest.raises(ValueError, match="buffer 1 has no data"):
        read_mesh(tmp_path / "a.glb")
    tree["extensionsUsed"] = ["EXT_meshopt_compression"]
    (tmp_path / "a.glb").write_bytes(glb(tree, arrays.content))
    with pytest.raises(ValueError, match="uses the extension EXT_meshopt_compression"):
        read_mesh(tmp_path / "a.glb")
