"""Readers of the two text formats of the Debian meshes (OBJ and AC3D), and a writer of binary PLY.

Only the geometry is read: positions and polygons, the latter cut into triangles. Both readers are strict about indices
and lenient about everything that they do not need.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from learn3d.files import limits, writing

Polygon = Sequence[int]


@dataclass(frozen=True)
class Part:
    """One named object of an AC3D file, in the frame of the file."""

    name: str
    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]


def read_obj(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices float64 [V, 3] and triangles int64 [F, 3] of a Wavefront OBJ text; ValueError if it is malformed."""
    rows: list[list[str]] = []
    polygons: list[Polygon] = []
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        fields = line.split()
        if not fields:
            continue
        if fields[0] == "v":
            rows.append(fields[1:4])
        elif fields[0] == "f" and len(fields) > 3:
            indices = [int(field.split("/", 1)[0]) for field in fields[1:]]
            polygons.append([i - 1 if i > 0 else len(rows) + i for i in indices])
    try:
        vertices = np.array(rows, dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise ValueError(f"an OBJ vertex needs three numbers ({error})") from error
    return vertices, triangulate(polygons, vertices)


def read_ac3d(text: str, skip: Callable[[str], bool] = lambda name: False) -> list[Part]:
    """Objects of an AC3D text with at least one polygon, placed by the `loc` and `rot` of their ancestors.

    An object whose name `skip` accepts is left out with its children; so are lines (surface types 1 and 2).
    Convention of FlightGear's models: nose towards -x, y up, left wing towards +z.
    Raises ValueError when the text is not AC3D or ends too early.
    """
    lines = iter(text.splitlines())
    if not next(lines, "").startswith("AC3D"):
        raise ValueError("an AC3D file starts with AC3D")
    parts: list[Part] = []
    # One entry per open ancestor: [children still to come, rotation of row vectors, translation, skipped].
    stack: list[list] = [[1, np.eye(3), np.zeros(3), False]]
    try:
        for line in lines:
            if line.startswith("OBJECT") and stack:
                _read_object(lines, stack, parts, skip)
    except (StopIteration, IndexError) as error:
        raise ValueError("the AC3D file ends in the middle of an object") from error
    return parts


def _next(lines: Iterator[str]) -> str:
    """The next line that is not blank (some exporters scatter blank ones); StopIteration at the end."""
    while not (line := next(lines).strip()):
        pass
    return line


def _read_object(lines: Iterator[str], stack: list[list], parts: list[Part], skip: Callable[[str], bool]) -> None:
    """Read one AC3D object up to its `kids` line; push it as the ancestor of its children."""
    stack[-1][0] -= 1
    _, rotation, translation, skipped = stack[-1]
    name, vertices, polygons, kind = "", np.zeros((0, 3)), [], -1
    own_rotation, own_translation = np.eye(3), np.zeros(3)
    while True:
        key, _, value = _next(lines).partition(" ")
        if key == "name":
            name = value.strip().strip('"')
        elif key == "data":
            size = int(value)
            while size > 0:  # free text of `size` characters, which may look like anything
                size -= len(next(lines)) + 1
        elif key == "loc":
            own_translation = np.array(value.split()[:3], dtype=np.float64)
        elif key == "rot":
            own_rotation = np.array(value.split()[:9], dtype=np.float64).reshape(3, 3)
        elif key == "numvert":
            vertices = np.array([_next(lines).split()[:3] for _ in range(int(value))], dtype=np.float64).reshape(-1, 3)
        elif key == "SURF":
            kind = int(value, 16) & 0xF
        elif key == "refs":
            polygon = [int(_next(lines).split()[0]) for _ in range(int(value))]
            if kind == 0 and len(polygon) > 2:
                polygons.append(polygon)
        elif key == "kids":
            children = int(value)
            break
    translation = own_translation @ rotation + translation
    rotation = own_rotation @ rotation
    skipped = skipped or skip(name)
    if polygons and not skipped:
        placed = vertices @ rotation + translation
        parts.append(Part(name, placed, triangulate(polygons, placed)))
    if children > 0:
        stack.append([children, rotation, translation, skipped])
    while stack and stack[-1][0] == 0:
        stack.pop()


def triangulate(polygons: Sequence[Polygon], vertices: np.ndarray) -> np.ndarray:
    """Triangles int64 [F, 3] of simple polygons, convex or not; ValueError when an index is outside of `vertices`.

    A quadrilateral is cut along the diagonal that keeps both normals on one side; a larger polygon is cut by ears in
    the plane of its Newell normal.
    """
    by_size: dict[int, list[Polygon]] = {}
    for polygon in polygons:
        by_size.setdefault(len(polygon), []).append(polygon)
    if (most := max(by_size, default=0)) > limits.POLYGON_CORNERS:
        raise ValueError(f"a polygon has {most} corners; at most {limits.POLYGON_CORNERS} are read")
    for polygon in polygons:
        if min(polygon) < 0 or max(polygon) >= len(vertices):  # of any size: before they become an array
            worst = max(polygon, key=abs)
            raise ValueError(f"a polygon names vertex {str(worst)[:20]}, but there are {len(vertices)} vertices")
    triangles = [np.array(by_size.pop(3, []), dtype=np.int64).reshape(-1, 3)]
    quads = np.array(by_size.pop(4, []), dtype=np.int64).reshape(-1, 4)
    first, second = _cut_quads(quads, vertices)
    triangles += [first, second]
    for size in sorted(by_size):
        for polygon in by_size[size]:
            triangles.append(np.array(_cut_ears(polygon, vertices), dtype=np.int64).reshape(-1, 3))
    return np.concatenate(triangles)


def _normals(triangles: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def _cut_quads(quads: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles [Q, 3] each of quadrilaterals [Q, 4]."""
    a, b = quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]
    c, d = quads[:, [1, 2, 3]], quads[:, [1, 3, 0]]
    folded = (_normals(a, vertices) * _normals(b, vertices)).sum(axis=1) < 0
    other_is_flat = (_normals(c, vertices) * _normals(d, vertices)).sum(axis=1) > 0
    use_other = (folded & other_is_flat)[:, None]
    return np.where(use_other, c, a), np.where(use_other, d, b)


def _cut_ears(polygon: Polygon, vertices: np.ndarray) -> list[tuple[int, int, int]]:
    """Triangles of one polygon with more than four corners, by ear clipping; what cannot be clipped is fanned."""
    points = vertices[list(polygon)]
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)  # Newell
    axis = int(np.abs(normal).argmax())
    u, v = ((1, 2), (2, 0), (0, 1))[axis]
    sign = 1.0 if normal[axis] >= 0 else -1.0
    flat = [(sign * p[u], p[v]) for p in points.tolist()]

    def turn(i: int, j: int, k: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = flat[i], flat[j], flat[k]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    left = list(range(len(polygon)))
    triangles = []
    while len(left) > 3:
        for at in range(len(left)):
            i, j, k = left[at - 1], left[at], left[(at + 1) % len(left)]
            if turn(i, j, k) > 0 and not any(
                turn(i, j, p) >= 0 and turn(j, k, p) >= 0 and turn(k, i, p) >= 0
                for p in left
                if flat[p] not in (flat[i], flat[j], flat[k])
            ):
                triangles.append((polygon[i], polygon[j], polygon[k]))
                del left[at]
                break
        else:
            break
    triangles += [(polygon[left[0]], polygon[left[i]], polygon[left[i + 1]]) for i in range(1, len(left) - 1)]
    return triangles


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a binary little-endian PLY: float32 vertices [V, 3], int32 faces [F, 3]."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("size", "u1"), ("face", "<i4", 3)])
    rows["size"], rows["face"] = 3, faces
    writing.write_bytes(path, header.encode("ascii") + vertices.astype("<f4").tobytes() + rows.tobytes())
