"""glTF 2.0, as JSON (.gltf) or binary (.glb): the triangles of the default scene, not animated.
Does not import torch, for processes without it.
"""

import base64
import contextlib
import json
import re
import struct
from collections.abc import Callable
from typing import Any, NamedTuple
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Required extensions with no effect on the triangles, or read here.
_HARMLESS = re.compile(
    r"KHR_mesh_quantization|(KHR|EXT|MSFT)_(materials|texture|lights|animation|xmp)\w*"
)
# Extensions whose data may stand beside plain data, which is then read.
_COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")


class GltfMaterial(NamedTuple):
    """The base colour of a material."""

    name: str
    factor: tuple[float, float, float]
    image: bytes | None  # an encoded image, which the factor multiplies


class Gltf(NamedTuple):
    """All meshes of a scene as one."""

    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]
    # [V, 2] of the image of the material, (0, 0) at its lower left corner; NaN without
    uv: np.ndarray
    colors: np.ndarray  # [V, 3], NaN without
    face_material: np.ndarray  # int64 [F], index in `materials`; -1 without
    materials: list[GltfMaterial]


def read_gltf(
    content: bytes, read_other: Callable[[str], bytes], with_materials: bool = False
) -> Gltf:
    """The triangles of a scene.

    Points and lines are skipped. read_other: content of a file by its name. with_materials: False
    leaves out texture coordinates, colours and materials. Raises EOFError if the file is cut
    short, and ValueError if it needs an extension that is not supported.
    """
    text, binary = _chunks(content) if content[:4] == b"glTF" else (content, None)
    if not text.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        raise ValueError("it begins with neither glTF nor {")
    if not text.rstrip().endswith(b"}"):
        raise EOFError("its JSON does not end")
    try:
        tree = json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    version = tree.get("asset", {}).get("version", "without a version")
    if not str(version).startswith("2"):
        raise ValueError(f"it is glTF {version}; version 2 is read")
    for name in tree.get("extensionsRequired", []):
        if not _HARMLESS.fullmatch(name):
            raise ValueError(
                f"it needs the extension {name}, which is not supported; save it without"
            )
    accessors = _Accessors(tree, binary, read_other)
    vertices, faces, total = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
    uv, colors, face_material = [np.empty((0, 2))], [np.empty((0, 3))], [np.empty(0, np.int64)]
    places = _places(tree)
    for node, place in [(tree["nodes"][number], place) for number, place in places.items()]:
        mesh = tree["meshes"][_index(node["mesh"])] if "mesh" in node else {"primitives": []}
        weights = node.get("weights", mesh.get("weights", []))
        for primitive in mesh["primitives"]:
            if primitive.get("mode", 4) < 4 or "POSITION" not in primitive["attributes"]:
                continue
            points = accessors.read(primitive["attributes"]["POSITION"])
            for weight, target in zip(weights, primitive.get("targets", []), strict=False):
                if weight and "POSITION" in target:
                    points = points + weight * accessors.read(target["POSITION"])
            if "skin" in node:
                skin = tree["skins"][_index(node["skin"])]
                points = _skinned(points, primitive["attributes"], skin, accessors, places)
                mirrored = False
            else:
                points = points @ place[:3, :3].T + place[:3, 3]
                mirrored = np.linalg.det(place[:3, :3]) < 0
            indices = np.arange(len(points))
            if "indices" in primitive:
                indices = accessors.read(primitive["indices"])[:, 0].astype(np.int64)
            if len(indices) and indices.max() >= len(points):
                raise ValueError(
                    f"a face refers to vertex {indices.max()}, but its mesh has {len(points)}"
                )
            # primitives may share one large array
            used, indices = np.unique(indices, return_inverse=True)
            triangles = _triangles(indices, primitive.get("mode", 4)) + total
            # so that their normals point to the same side as before
            faces.append(triangles[:, ::-1] if mirrored else triangles)
            vertices.append(points[used])
            total += len(used)
            number = primitive.get("material", -1) if with_materials else -1
            face_material.append(np.full(len(faces[-1]), number))
            source = accessors.color_texture(number) if number >= 0 else None
            given = primitive["attributes"] if with_materials else {}
            uv.append(accessors.texture_coordinates(source, given, len(points))[used])
            colors.append(np.full((len(used), 3), np.nan))
            if "COLOR_0" in given:
                colors[-1] = accessors.read(given["COLOR_0"])[used, :3]
    materials = range(len(tree.get("materials", []))) if with_materials else ()
    return Gltf(
        *(np.concatenate(parts) for parts in (vertices, faces, uv, colors, face_material)),
        [accessors.material(number) for number in materials],
    )


def _chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """The JSON text and the binary chunk of a GLB file."""
    if len(content) < 12:
        raise EOFError("its header does not end")
    _, version, length = struct.unpack_from("<4sII", content)
    if version != 2:
        raise ValueError(f"it is glTF {version}; version 2 is read")
    if length > len(content):
        raise EOFError(f"it has {len(content)} bytes; its header promises {length}")
    chunks = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<I4s", content, at)
        chunks.setdefault(kind, content[at + 8 : at + 8 + size])
        at += 8 + size
    return chunks[b"JSON"], chunks.get(b"BIN\0")


def _unsupported(name: str) -> ValueError:
    return ValueError(f"it uses the extension {name}, which is not supported; save it without")


class _Accessors:
    """The arrays of a file."""

    def __init__(
        self, tree: dict[str, Any], binary: bytes | None, read_other: Callable[[str], bytes]
    ) -> None:
        self.tree = tree
        self.binary = binary
        self.read_other = read_other
        self.buffers: dict[int, bytes] = {}

    def read(self, number: int) -> np.ndarray:
        """Accessor `number` as [count, components]; float64 for floats and normalised integers."""
        accessor = self.tree["accessors"][_index(number)]
        kind = _COMPONENTS[accessor["componentType"]]
        shape = (accessor["count"], _WIDTHS[accessor["type"]])
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            values = self._view(accessor["bufferView"], accessor.get("byteOffset", 0), kind, shape)
        elif sparse is None:
            raise self._no_data(f"accessor {number}")
        else:
            values = np.zeros(shape, kind)
        if sparse is not None:
            count = sparse["count"]
            values = values.copy()
            rows = sparse["indices"]
            new = sparse["values"]
            kind_of_rows = _COMPONENTS[rows["componentType"]]
            at = self._view(
                rows["bufferView"], rows.get("byteOffset", 0), kind_of_rows, (count, 1)
            )[:, 0]
            values[at] = self._view(
                new["bufferView"], new.get("byteOffset", 0), kind, (count, shape[1])
            )
        if accessor.get("normalized") and values.dtype.kind != "f":
            return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values.astype(np.float64) if values.dtype.kind == "f" else values

    def _view(self, number: int, offset: int, kind: str, shape: tuple[int, int]) -> np.ndarray:
        view = self.tree["bufferViews"][_index(number)]
        dtype = np.dtype(kind)
        width = shape[1] * dtype.itemsize
        stride = view.get("byteStride") or width
        offset = _index(offset)
        data = self._buffer(view.get("buffer", 0))
        start = _index(view.get("byteOffset", 0))
        needed = offset + stride * (shape[0] - 1) + width if shape[0] else 0
        if needed > view["byteLength"] or start + needed > len(data):
            raise ValueError(f"an array of {shape[0]} elements exceeds its buffer")
        return np.ndarray(shape, dtype, data, start + offset, (stride, dtype.itemsize))

    def _buffer(self, number: int) -> bytes:
        if number not in self.buffers:
            buffer = self.tree["buffers"][_index(number)]
            uri = buffer.get("uri")
            if uri is None and (self.binary is None or number > 0):
                raise self._no_data(f"buffer {number}")
            if uri is None:
                data = self.binary
            else:
                data = self._content(uri)
            if len(data) < buffer["byteLength"]:
                raise EOFError(
                    f"buffer {number} has {len(data)} bytes; {buffer['byteLength']} are promised"
                )
            self.buffers[number] = data
        return self.buffers[number]

    def _content(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            kind, _, text = uri.partition(",")
            data = unquote_to_bytes(text)
            return base64.b64decode(data) if kind.endswith(";base64") else data
        name = unquote(uri)
        for other in (name, uri):  # some programs do not encode names, or write backslashes
            with contextlib.suppress(FileNotFoundError):
                return self.read_other(other)
        return self.read_other(name.replace("\\", "/"))

    def _no_data(self, what: str) -> ValueError:
        """The error for data that are missing, or only there in compressed form."""
        used = [name for name in self.tree.get("extensionsUsed", []) if name in _COMPRESSIONS]
        return _unsupported(used[0]) if used else ValueError(f"{what} has no data")

    def material(self, number: int) -> GltfMaterial:
        material = self.tree["materials"][number]
        texture, image = self.color_texture(number), None
        factor = _base(material).get("baseColorFactor", (1.0, 1.0, 1.0))[:3]
        if texture is not None:
            image = self._image(self.tree["textures"][_index(texture["index"])])
        return GltfMaterial(material.get("name", ""), tuple(map(float, factor)), image)

    def color_texture(self, number: int) -> dict[str, Any] | None:
        """How a material uses the texture of its base colour, if it has one."""
        return _base(self.tree["materials"][_index(number)]).get("baseColorTexture")

    def _image(self, texture: dict[str, Any]) -> bytes:
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        if "source" not in texture | webp:
            raise ValueError("a texture has no image in the format PNG, JPEG or WebP")
        image = self.tree["images"][_index((texture | webp)["source"])]
        if "bufferView" in image:
            view = self.tree["bufferViews"][_index(image["bufferView"])]
            size = view["byteLength"]
            return self._view(image["bufferView"], 0, "u1", (size, 1)).tobytes()
        return self._content(image["uri"])

    def texture_coordinates(
        self, texture: dict[str, Any] | None, attributes: dict[str, int], count: int
    ) -> np.ndarray:
        """[count, 2] for a texture of a material, v upwards; NaN if there are none."""
        name = f"TEXCOORD_{(texture or {}).get('texCoord', 0)}"
        if texture is None or name not in attributes:
            return np.full((count, 2), np.nan)
        uv = self.read(attributes[name])[:, :2]
        change = texture.get("extensions", {}).get("KHR_texture_transform", {})
        if f"TEXCOORD_{change.get('texCoord', '')}" in attributes:
            uv = self.read(attributes[f"TEXCOORD_{change['texCoord']}"])[:, :2]
        angle = change.get("rotation", 0.0)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        uv = uv * change.get("scale", (1, 1)) @ turn.T + change.get("offset", (0, 0))
        return np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)


def _base(material: dict[str, Any]) -> dict[str, Any]:
    return material.get("pbrMetallicRoughness", {})


def _index(number: int) -> int:
    if number < 0:
        raise ValueError(f"it has the negative index {number}")
    return number


def _places(tree: dict[str, Any]) -> dict[int, np.ndarray]:
    """The matrix [4, 4] of each node of the default scene (of all nodes, if there is no scene)."""
    nodes = tree.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [number for number in range(len(nodes)) if number not in children]
    if tree.get("scenes"):
        roots = tree["scenes"][_index(tree.get("scene", 0))].get("nodes", [])
    waiting = [(number, np.eye(4)) for number in reversed(roots)]
    places = {}
    while waiting:
        number, parent = waiting.pop()
        if number in places:
            raise ValueError(f"node {number} has several parents")
        node = nodes[_index(number)]
        if (instances := "EXT_mesh_gpu_instancing") in node.get("extensions", {}):
            raise _unsupported(instances)
        places[number] = parent @ _matrix(node)
        waiting += [(child, places[number]) for child in reversed(node.get("children", []))]
    return places


def _skinned(
    points: np.ndarray,
    attributes: dict[str, int],
    skin: dict[str, Any],
    accessors: _Accessors,
    places: dict[int, np.ndarray],
) -> np.ndarray:
    """Points [N, 3] moved by the joints of their skin.

    The place of the mesh itself has no effect.
    """
    joints = np.stack([places[number] for number in skin["joints"]])
    if "inverseBindMatrices" in skin:
        joints = joints @ accessors.read(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(
            1, 2
        )
    moved = np.zeros_like(points)
    for which in (name for name in attributes if name.startswith("JOINTS_")):
        weights = accessors.read(attributes[which.replace("JOINTS", "WEIGHTS")])
        for joint, weight in zip(accessors.read(attributes[which]).T, weights.T, strict=True):
            matrices = joints[joint]
            moved += weight[:, None] * (
                (matrices[:, :3, :3] @ points[:, :, None])[:, :, 0] + matrices[:, :3, 3]
            )
    return moved


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """The matrix [4, 4] of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    quaternion = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    x, y, z, w = quaternion / (np.linalg.norm(quaternion) or 1.0)
    # cross @ v is the cross product of (x, y, z) with v
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    matrix = np.eye(4)
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """Faces [F, 3] of indices [N] as triangles (mode 4), a strip (5) or a fan (6)."""
    if mode == 4:
        return indices.reshape(-1, 3)
    if mode == 5:
        faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]
        return faces
    if mode == 6:
        return np.stack(
            [np.broadcast_to(indices[:1], len(indices[2:])), indices[1:-1], indices[2:]], axis=1
        )
    raise ValueError(f"it has a primitive of the unknown mode {mode}")
