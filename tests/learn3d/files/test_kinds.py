"""What programs write in each format, as a table, and random files over it: the same triangles must come back.

FILES=5000 in the environment makes more of them than the usual few.
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
from gltf_files import Arrays, glb

from learn3d.files.formats import read_mesh

FILES = int(os.environ.get("FILES", "150"))
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
        "tail": ["", "\n\n"],
    },
    "a.ply": {
        "mark": ["", "\ufeff"],
        "format": ["ascii", "binary_little_endian", "binary_big_endian"],
        "line": ["\n", "\r\n"],
        "comment": ["", "comment größe\n", "obj_info 3 4\n"],
        "type": ["float", "double", "float32"],
        "more": ["", "nx", "red"],
        "list": ["uchar int vertex_indices", "uint8 int32 vertex_index", "int uint vertex_indices",
                 "uchar ushort vertex_index"],
        "extra": ["", "edge"],
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
        "compressed": [None, "KHR_draco_mesh_compression", "EXT_meshopt_compression"],
        "indices": [None, "<u2", "<u4"],
        "tail": ["", "\n", "  "],
    },
}  # fmt: skip


def corners(rng: np.random.Generator) -> np.ndarray:
    """Two or three triangles [F, 3, 3] with few digits, of which two share an edge."""
    points = rng.integers(-99, 99, (5, 3)) / 8
    return points[[[0, 1, 2], [2, 1, 3], [3, 4, 0]]][: rng.integers(2, 4)]


def text_stl(k: Choice, faces: np.ndarray) -> bytes:
    lines = []
    for part in np.array_split(faces, k["solids"]):
        lines.append(f"solid{k['name']}")
        for face in part:
            lines.append("facet normal 0 0 1\n outer loop")
            lines += ["vertex " + " ".join(map(k["number"].format, p)) for p in face.tolist()]
            lines += [" endloop", k["facet_end"]]
        lines.append(k["end"].format(name=k["name"]))
    text = k["case"]("\n".join(lines)).replace(" ", k["gap"]).replace("\n", k["line"])
    return (k["mark"] + k["before"] + text + k["tail"]).encode()


def binary_stl(k: Choice, faces: np.ndarray) -> bytes:
    count = len(faces) if k["count"] == "right" else k["count"]
    rows = [bytes(12) + face.astype("<f4").tobytes() + k["attribute"] for face in faces]
    tail = k["tail"] if k["count"] == "right" else b""  # else the length tells the count
    return k["head"].ljust(80, k["fill"]) + struct.pack("<I", count) + b"".join(rows) + tail


def off(k: Choice, faces: np.ndarray) -> bytes:
    after = {"COFF": " 255 0 0 255", "NOFF": " 0 0 1", "CNOFF": " 0 0 1 1 0 0 1", "STOFF": " 0 1"}
    points = faces.reshape(-1, 3).tolist()
    rows = [" ".join(map(repr, p)) + after.get(k["head"], "") for p in points]
    rows += [k["face"].format(f"3 {i} {i + 1} {i + 2}") for i in range(0, len(points), 3)]
    rows = [f"{len(points)} {len(faces)}{k['edges']}", *rows]
    text = k["before"] + k["head"] + k["glue"] + ("\n" + k["blank"]).join(rows) + k["tail"]
    return (k["mark"] + text.replace(" ", k["gap"]).replace("\n", k["line"])).encode()


def ply(k: Choice, faces: np.ndarray) -> bytes:
    order = "<" if "little" in k["format"] else ">"
    codes = {"float": "f", "float32": "f", "double": "d", "uchar": "B", "uint8": "B"}
    codes |= {"int": "i", "int32": "i", "uint": "I", "ushort": "H"}
    count, index, name = k["list"].split()
    points = faces.reshape(-1, 3).tolist()
    head = f"ply\nformat {k['format']} 1.0\n{k['comment']}element vertex {len(points)}\n"
    head += "".join(f"property {k['type']} {axis}\n" for axis in "xyz")
    head += f"property uchar {k['more']}\n" if k["more"] else ""
    extra = f"element {k['extra']} 2\nproperty int vertex1\n" if k["extra"] else ""
    head += f"{extra}element face {len(faces)}\nproperty list {count} {index} {name}\nend_header\n"
    rows = [[(codes[k["type"]], x) for x in p] + [("B", 7)] * bool(k["more"]) for p in points]
    rows += [[("i", 3)]] * 2 * bool(k["extra"])
    rows += [
        [(codes[count], 3), *((codes[index], i + j) for j in range(3))]
        for i in range(0, len(points), 3)
    ]
    if k["format"] == "ascii":
        body = "".join(" ".join(str(x) for _, x in row) + k["line"] for row in rows).encode()
    else:
        body = b"".join(struct.pack(order + code, x) for row in rows for code, x in row)
    return (k["mark"] + head.replace("\n", k["line"])).encode() + body


def obj(k: Choice, faces: np.ndarray) -> bytes:
    points = faces.reshape(-1, 3).tolist()
    lines = ["v " + " ".join(map(k["number"].format, p)) + k["color"] for p in points]
    text = "\n".join(lines) + "\n" + k["between"]
    text += "" if "vt " in text else "vt 0 0\n"
    for i in range(0, len(points), 3):
        first = i - len(points) if k["relative"] else i + 1
        words = [k["corner"].format(first + j) for j in range(3)]
        gap = " \\\n" if k["continued"] else " "
        text += f"{k['indent']}f {words[0]}{gap}{words[1]} {words[2]}{k['end']}\n"
    text = k["head"] + k["case"](text).replace(" ", k["gap"])
    return (k["mark"] + text + k["tail"]).replace("\n", k["line"]).encode()


def gltf(k: Choice, faces: np.ndarray, folder: Path) -> bytes:
    arrays = Arrays()
    primitive = {"attributes": {"POSITION": arrays.add(faces.reshape(-1, 3).astype("<f4"))}}
    if k["indices"]:
        primitive["indices"] = arrays.add(np.arange(3 * len(faces), dtype=k["indices"]))
    tree = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}  # fmt: skip
    tree |= arrays.tree(embedded=k["place"] != "chunk")
    if k["compressed"]:
        tree["extensionsUsed"] = [k["compressed"]]
        owner = primitive if "draco" in k["compressed"] else tree["bufferViews"][0]
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


WRITERS = {"text.stl": text_stl, "binary.stl": binary_stl, "a.off": off, "a.ply": ply, "a.obj": obj}


def choose(kinds: dict[str, list], rng: np.random.Generator) -> Choice:
    return {name: values[rng.integers(len(values))] for name, values in kinds.items()}


@pytest.mark.parametrize("name", KINDS)
def test_files_of_all_kinds_have_their_triangles(tmp_path: Path, name: str) -> None:
    rng, wrong = np.random.default_rng(sum(name.encode())), []
    for _ in range(max(1, FILES // len(KINDS))):
        kind, faces = choose(KINDS[name], rng), corners(rng)
        folder = tmp_path / f"{rng.integers(2**60)}"
        folder.mkdir()
        content = WRITERS[name](kind, faces) if name in WRITERS else gltf(kind, faces, folder)
        path = folder / ("a.glb" if kind.get("place") == "chunk" else name)
        path.write_bytes(content)
        try:
            mesh = read_mesh(path)
            found = mesh.vertices[mesh.faces]
            if found.shape != faces.shape or np.abs(found - faces).max() > 1e-6:
                wrong.append((kind, found.tolist()))
        except ValueError as error:
            wrong.append((kind, str(error)))
    assert not wrong, (len(wrong), wrong[:2])


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
