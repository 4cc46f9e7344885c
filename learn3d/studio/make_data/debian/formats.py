"""Reads meshes in the formats of Debian's packages: Wavefront OBJ and AC3D. Positions and triangles only.

trimesh does not read AC3D. From OBJ it makes a fan of each polygon, which fills the gaps of concave polygons such as
the backs of some chairs.
"""

import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from learn3d.files.formats import RawMesh


def read_obj(text: str) -> RawMesh:
    """Vertices and triangles of a Wavefront OBJ text; ValueError if it is malformed."""
    rows, polygons = [], []
    for line in text.splitlines():
        key, *fields = line.split() or [""]
        if key == "v":
            rows.append(fields[:3])
        elif key == "f" and len(fields) > 2:
            indices = [int(field.split("/", 1)[0]) for field in fields]
            polygons.append([i - 1 if i > 0 else len(rows) + i for i in indices])
    return triangulate(np.array(rows, dtype=np.float64).reshape(-1, 3), polygons)


def read_ac3d(text: str, skip: Callable[[str], object]) -> list[RawMesh]:
    """Objects of an AC3D text with at least one polygon, placed by the `loc` and `rot` of their ancestors.

    Skips lines (surface types 1 and 2), and objects with a name that `skip` accepts, with their children. Frame of
    FlightGear's models: nose towards -x, y up, left wing towards +z. Raises ValueError if the text is not AC3D or
    incomplete.
    """
    lines = (line for line in map(str.strip, text.splitlines()) if line)  # some exporters add blank lines
    if not next(lines, "").startswith("AC3D"):
        raise ValueError("not an AC3D file: it does not start with AC3D")
    try:
        return list(_read_objects(lines, 1, np.eye(3), np.zeros(3), skip))
    except (RuntimeError, LookupError) as error:  # a generator turns StopIteration into a RuntimeError
        raise ValueError("the AC3D file ends in the middle of an object") from error


def _read_objects(
    lines: Iterator[str], count: int, rotation: np.ndarray, translation: np.ndarray, skip: Callable[[str], object]
) -> Iterator[RawMesh]:
    """The next `count` objects with their children. The parent's frame is v @ rotation [3, 3] + translation [3]."""
    for _ in range(count):
        if not any(line.startswith("OBJECT") for line in lines):
            return
        fields, rows, polygons, key = {"name": "", "rot": "1 0 0 0 1 0 0 0 1", "loc": "0 0 0"}, [], [], ""
        while key != "kids":
            key, _, value = next(lines).partition(" ")
            fields[key] = value
            if key == "data":
                next(lines)  # free text, which may look like a key
            elif key == "numvert":
                rows = [next(lines).split()[:3] for _ in range(int(value))]
            elif key == "refs":
                polygon = [int(next(lines).split()[0]) for _ in range(int(value))]
                if int(fields["SURF"], 16) & 0xF == 0 and len(polygon) > 2:
                    polygons.append(polygon)
        turn, shift = (np.array(fields[key].split(), dtype=np.float64) for key in ("rot", "loc"))
        turn, shift = turn.reshape(3, 3) @ rotation, shift @ rotation + translation
        children = list(_read_objects(lines, int(value), turn, shift, skip))
        if not skip(fields["name"].strip('"')):
            if polygons:
                yield triangulate(np.array(rows, dtype=np.float64).reshape(-1, 3) @ turn + shift, polygons)
            yield from children


def triangulate(vertices: np.ndarray, polygons: Sequence[Sequence[int]]) -> RawMesh:
    """The mesh of simple polygons, convex or not; ValueError if an index is outside of the vertices [V, 3].

    A polygon is cut into a fan from its first corner if that does not fold over, else by its ears.
    """
    triangles = [np.empty((0, 3), dtype=np.int64)]
    for size, group in itertools.groupby(sorted(polygons, key=len), key=len):
        corners = np.array(list(group), dtype=np.int64)  # [P, size]
        if corners.min() < 0 or corners.max() >= len(vertices):
            raise ValueError(f"a polygon refers to a missing vertex; there are {len(vertices)}")
        points = vertices[corners]
        points = points - points[:, :1]
        normals = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)  # Newell's method: right for concave ones
        fan = np.stack([np.zeros(size - 2, dtype=np.int64), np.arange(1, size - 1), np.arange(2, size)], axis=1)
        areas = np.cross(points[:, 1:-1], points[:, 2:])
        folded = ((areas * normals[:, None]).sum(axis=2) < 0).any(axis=1)
        triangles.append(corners[~folded][:, fan].reshape(-1, 3))
        triangles += [corners[i][np.array(_cut_ears(points[i], normals[i]))] for i in np.flatnonzero(folded)]
    return RawMesh(vertices, np.concatenate(triangles))


def _cut_ears(points: np.ndarray, normal: np.ndarray) -> list[tuple[int, int, int]]:
    """N - 2 triangles of a polygon [N, 3], by ear clipping in the coordinate plane of its largest projection."""
    axis = int(np.abs(normal).argmax())
    u, v = (axis + 1) % 3, (axis + 2) % 3
    flat = points[:, [u, v] if normal[axis] >= 0 else [v, u]]  # counter-clockwise

    def left_of(a: int, b: int, others: int | list[int]) -> np.ndarray:
        """Twice the signed area of the triangles from a to b to each of the others: positive on the left."""
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
            break  # the polygon crosses itself and has no ear: the rest becomes a fan
    return triangles + [(corners[0], *pair) for pair in itertools.pairwise(corners[1:])]
