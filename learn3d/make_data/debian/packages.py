"""Reads files from Debian packages without installing them, and meshes in their formats OBJ and AC3D.

trimesh does not read AC3D. From OBJ it makes a fan of each polygon, which fills the gaps of concave polygons such as
the backs of some chairs. These readers return positions and triangles only.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Candidate(NamedTuple):
    """A model in a package."""

    category: str
    title: str
    author: str
    licence: str
    source: str  # path inside the package
    stem: str  # file name to use, without suffix
    read: Callable[[], tuple[np.ndarray, np.ndarray]]  # vertices float64 [V, 3] (y up, front +z), faces int64 [F, 3]


def get_package(name: str, folder: Path) -> Path:
    """The .deb file of a package in `folder`. If it is missing, apt-get downloads it, which needs no root rights.

    Raises ValueError if apt-get fails, OSError if it is not installed.
    """
    if not any(folder.glob(f"{name}_*.deb")):
        result = subprocess.run(["apt-get", "download", "-q", name], cwd=folder, capture_output=True, text=True)
        if result.returncode != 0:
            raise ValueError(
                f"apt-get could not download {name} ({result.stderr.strip()}); run `apt-get update` as root, enable "
                "the component non-free if the package is in it, or put the .deb file into the folder --packages-dir"
            )
    return max(folder.glob(f"{name}_*.deb"), key=lambda path: [*map(int, re.findall(r"\d+", path.name))])


def read_package(package: Path, suffixes: tuple[str, ...]) -> dict[str, bytes]:
    """The regular files of a .deb file whose paths (relative to /) end in one of `suffixes`: path -> content.

    Raises ValueError for a damaged file, OSError if dpkg-deb is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        if subprocess.run(["dpkg-deb", "--extract", package, folder], capture_output=True).returncode != 0:
            raise ValueError(f"{package} cannot be read as a Debian package; download it again")
        found = [path for path in Path(folder).rglob("*") if path.as_posix().endswith(suffixes)]
        regular = [path for path in found if path.is_file() and not path.is_symlink()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in regular}


class Part(NamedTuple):
    """One object of an AC3D file, in the frame of the file."""

    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]


def read_obj(text: str) -> Part:
    """Vertices and triangles of a Wavefront OBJ text; ValueError if it is malformed."""
    rows, polygons = [], []
    for line in text.splitlines():
        fields = line.split() or [""]
        if fields[0] == "v":
            rows.append(fields[1:4])
        elif fields[0] == "f" and len(fields) > 3:
            indices = [int(field.split("/", 1)[0]) for field in fields[1:]]
            polygons.append([i - 1 if i > 0 else len(rows) + i for i in indices])
    vertices = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return Part(vertices, triangulate(polygons, vertices))


def read_ac3d(text: str, skip: Callable[[str], object]) -> list[Part]:
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
    except (RuntimeError, IndexError) as error:  # a generator turns StopIteration into a RuntimeError
        raise ValueError("the AC3D file ends in the middle of an object") from error


def _read_objects(
    lines: Iterator[str], count: int, rotation: np.ndarray, translation: np.ndarray, skip: Callable[[str], object]
) -> Iterator[Part]:
    """The next `count` objects with their children. The parent's frame is v @ rotation [3, 3] + translation [3]."""
    for _ in range(count):
        if not any(line.startswith("OBJECT") for line in lines):
            return
        name, vertices, polygons, kind, key = "", np.zeros((0, 3)), [], -1, ""
        turn, shift = np.eye(3), np.zeros(3)
        while key != "kids":
            key, _, value = next(lines).partition(" ")
            if key == "name":
                name = value.strip('"')
            elif key == "data":
                next(lines)  # free text, which may look like a key
            elif key == "loc":
                shift = np.array(value.split(), dtype=np.float64)
            elif key == "rot":
                turn = np.array(value.split(), dtype=np.float64).reshape(3, 3)
            elif key == "numvert":
                rows = [next(lines).split()[:3] for _ in range(int(value))]
                vertices = np.array(rows, dtype=np.float64).reshape(-1, 3)
            elif key == "SURF":
                kind = int(value, 16) & 0xF
            elif key == "refs":
                polygon = [int(next(lines).split()[0]) for _ in range(int(value))]
                if kind == 0 and len(polygon) > 2:
                    polygons.append(polygon)
        turn, shift = turn @ rotation, shift @ rotation + translation
        children = list(_read_objects(lines, int(value), turn, shift, skip))
        if not skip(name):
            placed = vertices @ turn + shift
            yield from [Part(placed, triangulate(polygons, placed))] if polygons else []
            yield from children


def triangulate(polygons: Sequence[Sequence[int]], vertices: np.ndarray) -> np.ndarray:
    """Triangles int64 [F, 3] of simple polygons, convex or not; ValueError if an index is outside of `vertices`.

    A polygon is cut into a fan from its first corner if that does not fold over, else by its ears.
    """
    by_size: dict[int, list[Sequence[int]]] = {}
    for polygon in polygons:
        if min(polygon) < 0 or max(polygon) >= len(vertices):
            raise ValueError(f"polygon {polygon} refers to a missing vertex; there are {len(vertices)}")
        by_size.setdefault(len(polygon), []).append(polygon)
    triangles = [np.empty((0, 3), dtype=np.int64)]
    for size in sorted(by_size):
        corners = np.array(by_size[size], dtype=np.int64)  # [P, size]
        points = vertices[corners]
        points = points - points[:, :1]
        normals = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)  # Newell's method: right for concave ones
        fan = np.stack([np.zeros(size - 2, dtype=np.int64), np.arange(1, size - 1), np.arange(2, size)], axis=1)
        areas = np.cross(points[:, 1:-1], points[:, 2:])
        folded = ((areas * normals[:, None]).sum(axis=2) < 0).any(axis=1)
        triangles.append(corners[~folded][:, fan].reshape(-1, 3))
        triangles += [corners[i][np.array(_cut_ears(points[i], normals[i]))] for i in np.flatnonzero(folded)]
    return np.concatenate(triangles)


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
    return triangles + [(corners[0], *pair) for pair in pairwise(corners[1:])]
