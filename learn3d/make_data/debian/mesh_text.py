"""Readers of the two text formats of the Debian meshes: OBJ, and AC3D, which trimesh does not know.

Only the geometry is read: positions and polygons, the latter cut into triangles. trimesh reads OBJ, too, but makes a
fan of every polygon, which covers the gaps of concave ones (the backs of some chairs).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from learn3d.files import limits


@dataclass(frozen=True)
class Part:
    """One named object of an AC3D file, in the frame of the file."""

    name: str
    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]


def read_obj(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices float64 [V, 3] and triangles int64 [F, 3] of a Wavefront OBJ text; ValueError if it is malformed."""
    rows, polygons = [], []
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        fields = line.split() or [""]
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
    Raises ValueError if the text is not AC3D or ends too early.
    """
    lines = iter(text.splitlines())
    if not next(lines, "").startswith("AC3D"):
        raise ValueError("an AC3D file starts with AC3D")
    parts: list[Part] = []
    try:
        _read_objects(lines, 1, np.eye(3), np.zeros(3), skip, parts)
    except (StopIteration, IndexError, RecursionError) as error:
        raise ValueError("the AC3D file ends in the middle of an object, or its objects are nested too deep") from error
    return parts


def _read_objects(
    lines: Iterator[str],
    count: int,
    rotation: np.ndarray,
    translation: np.ndarray,
    skip: Callable[[str], bool],
    parts: list[Part],
) -> None:
    """Add `count` objects and their children to `parts`; rotation [3, 3] (of row vectors) is that of their parent."""
    while count > 0 and (line := next(lines, None)) is not None:
        if not line.startswith("OBJECT"):
            continue
        count -= 1
        name, vertices, polygons, kind, key = "", np.zeros((0, 3)), [], -1, ""
        turn, shift = np.eye(3), np.zeros(3)
        while key != "kids":
            key, _, value = _next(lines).partition(" ")
            if key == "name":
                name = value.strip().strip('"')
            elif key == "data":
                size = int(value)
                while size > 0:  # free text of `size` characters, which may look like anything
                    size -= len(next(lines)) + 1
            elif key == "loc":
                shift = np.array(value.split()[:3], dtype=np.float64)
            elif key == "rot":
                turn = np.array(value.split()[:9], dtype=np.float64).reshape(3, 3)
            elif key == "numvert":
                rows = [_next(lines).split()[:3] for _ in range(int(value))]
                vertices = np.array(rows, dtype=np.float64).reshape(-1, 3)
            elif key == "SURF":
                kind = int(value, 16) & 0xF
            elif key == "refs":
                polygon = [int(_next(lines).split()[0]) for _ in range(int(value))]
                if kind == 0 and len(polygon) > 2:
                    polygons.append(polygon)
        turn, shift = turn @ rotation, shift @ rotation + translation
        kept = [] if skip(name) else parts
        if polygons:
            placed = vertices @ turn + shift
            kept.append(Part(name, placed, triangulate(polygons, placed)))
        _read_objects(lines, int(value), turn, shift, skip, kept)


def _next(lines: Iterator[str]) -> str:
    """The next line that is not blank (some exporters scatter blank ones); StopIteration at the end."""
    while not (line := next(lines).strip()):
        pass
    return line


def triangulate(polygons: Sequence[Sequence[int]], vertices: np.ndarray) -> np.ndarray:
    """Triangles int64 [F, 3] of simple polygons, convex or not; ValueError if an index is outside of `vertices`.

    A polygon is cut into a fan from its first corner if that does not fold over, else by its ears.
    """
    by_size: dict[int, list[Sequence[int]]] = {}
    for polygon in polygons:
        if min(polygon) < 0 or max(polygon) >= len(vertices):  # of any size: before they become an array
            worst = max(polygon, key=abs)
            raise ValueError(f"a polygon names vertex {str(worst)[:20]}, but there are {len(vertices)} vertices")
        by_size.setdefault(len(polygon), []).append(polygon)
    if (most := max(by_size, default=0)) > limits.POLYGON_CORNERS:
        raise ValueError(f"a polygon has {most} corners; at most {limits.POLYGON_CORNERS} are read")
    triangles = [np.empty((0, 3), dtype=np.int64)]
    for size in sorted(by_size):
        corners = np.array(by_size[size], dtype=np.int64)  # [P, size]
        points = vertices[corners]
        points = points - points[:, :1]
        normals = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)  # Newell's: the area's, of any polygon
        fan = np.stack([np.zeros(size - 2, dtype=np.int64), np.arange(1, size - 1), np.arange(2, size)], axis=1)
        areas = np.cross(points[:, 1:-1], points[:, 2:])
        folded = ((areas * normals[:, None]).sum(axis=2) < 0).any(axis=1)
        triangles.append(corners[~folded][:, fan].reshape(-1, 3))
        triangles += [corners[i][np.array(_cut_ears(points[i], normals[i]))] for i in np.flatnonzero(folded)]
    return np.concatenate(triangles)


def _cut_ears(points: np.ndarray, normal: np.ndarray) -> list[tuple[int, int, int]]:
    """Triangles of one polygon [N, 3], cut in the coordinate plane that sees most of it; all N corners are used."""
    axis = int(np.abs(normal).argmax())
    u, v = (axis + 1) % 3, (axis + 2) % 3
    flat = points[:, [u, v] if normal[axis] >= 0 else [v, u]]  # counter-clockwise

    def left_of(a: int, b: int, others: int | list[int]) -> np.ndarray:
        """Twice the area of the triangle from a to b to each of the others: above 0 on the left."""
        (x, y), to = flat[b] - flat[a], flat[others] - flat[a]
        return x * to[..., 1] - y * to[..., 0]

    corners, triangles = list(range(len(points))), []
    while len(corners) > 3:
        for at, j in enumerate(corners):
            i, k = corners[at - 1], corners[(at + 1) % len(corners)]
            inside = (left_of(i, j, corners) >= 0) & (left_of(j, k, corners) >= 0) & (left_of(k, i, corners) >= 0)
            own = (flat[corners][:, None] == flat[[i, j, k]]).all(axis=2).any(axis=1)
            if left_of(i, j, k) > 0 and not (inside & ~own).any():
                triangles.append((i, j, k))
                del corners[at]
                break
        else:
            break  # nothing can be cut off (the polygon crosses itself): the rest becomes a fan
    return triangles + [(corners[0], *pair) for pair in pairwise(corners[1:])]
