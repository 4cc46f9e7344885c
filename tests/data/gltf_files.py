"""The parts of glTF files: arrays with their description, JSON with an embedded buffer, and GLB."""

from __future__ import annotations

import base64
import json
import struct

import numpy as np

COMPONENTS = {"f4": 5126, "i2": 5122, "u2": 5123, "u4": 5125, "u1": 5121}
WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Arrays:
    """Arrays in one buffer; number k has accessor k and buffer view k."""

    def __init__(self) -> None:
        self.accessors, self.views, self.content = [], [], b""

    def add(self, values: np.ndarray, **about: object) -> int:
        """The number of the array; its accessor may say more `about` it."""
        start = -(-len(self.content) // 4) * 4
        self.content = self.content.ljust(start, b"\0") + values.tobytes()
        self.views.append({"buffer": 0, "byteOffset": start, "byteLength": values.nbytes})
        kind = {
            "componentType": COMPONENTS[values.dtype.str[1:]],
            "type": WIDTHS[values[0].size],
            "count": len(values),
        }
        self.accessors.append({"bufferView": len(self.accessors)} | kind | about)
        return len(self.accessors) - 1

    def tree(self, embedded: bool) -> dict[str, list]:
        """The entries of a glTF file about the arrays; without a URI the buffer is GLB's."""
        buffer = {"byteLength": len(self.content)}
        if embedded:
            buffer["uri"] = f"data:;base64,{base64.b64encode(self.content).decode()}"
        return {"accessors": self.accessors, "bufferViews": self.views, "buffers": [buffer]}


def glb(tree: dict[str, object], content: bytes) -> bytes:
    """A GLB file."""
    chunks = b""
    for kind, data, filler in (
        (b"JSON", json.dumps(tree).encode(), b" "),
        (b"BIN\0", content, b"\0"),
    ):
        data = data.ljust(-(-len(data) // 4) * 4, filler)
        chunks += struct.pack("<I4s", len(data), kind) + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


SQUARE = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def square_glb(picture: bytes | None = None, factor: tuple = (1, 1, 1, 1), **use: object) -> bytes:
    """A square: triangle 0 with a picture and texture coordinates, 1 in a colour, 2 without a material.

    use: how material 0 uses the picture.
    """
    arrays = Arrays()
    position, uv = arrays.add(SQUARE), arrays.add(SQUARE[:, :2].copy())
    colors = arrays.add(
        np.uint8([[255, 0, 0], [0, 255, 0], [0, 0, 255], [0, 0, 0]]), normalized=True
    )
    looks = [
        {"attributes": {"POSITION": position, "TEXCOORD_0": uv}, "material": 0},
        {"attributes": {"POSITION": position, "TEXCOORD_0": uv}, "material": 1},
        {"attributes": {"POSITION": position, "COLOR_0": colors}},
    ]
    corners = [np.uint16(row).reshape(3, 1) for row in ([0, 1, 2], [0, 2, 3], [1, 2, 3])]
    for look, rows in zip(looks, corners, strict=True):
        look["indices"] = arrays.add(rows)
    materials = [
        {"name": "a", "pbrMetallicRoughness": {"baseColorFactor": factor}},
        {"name": "b", "pbrMetallicRoughness": {"baseColorFactor": [0, 0.5, 1, 1]}},
    ]
    tree = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "meshes": [{"primitives": looks}]}
    if picture is not None:
        materials[0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0} | use
        tree |= {"textures": [{"source": 0}], "images": [{"bufferView": len(arrays.views)}]}
        arrays.add(np.frombuffer(picture, np.uint8))
    return glb(tree | {"materials": materials} | arrays.tree(embedded=False), arrays.content)
