"""Wavefront OBJ and MTL files, and polygons cut into triangles. Imports NumPy alone, for
processes without torch.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Collection, Iterable
from typing import BinaryIO, NamedTuple

import numpy as np

_CHUNK = 2**18  # bytes that are parsed at a time
_MOST_BYTES = 2**30  # limit of an .obj or .mtl file
_MOST_EARS = 4096  # corners of a polygon that is no fan; the time grows with their square
_LARGEST = float(np.finfo(np.float32).max)
_OPTIONS = r"(?:-(?:[sot](?:\s+[-+.\d][-+.\deE]*){1,3}|mm\s+\S+\s+\S+|[a-zA-Z]+\s+\S+)\s+)*"  # of a line `map_Kd`
# A line of a vertex that has words behind its numbers.
_WORDS = re.compile(rb"(?mi)^(\s*v(?:[^\S\n]+[-+.\de]+(?=\s)){3,})[^\S\n]+[^-+.\d\s][^\n]*")


class Obj(NamedTuple):
    """The triangles of an OBJ file, in the order of its polygons. Indices count from 0."""

    vertices: np.ndarray  # float64 [V, 3]
    # float64 [V, 3] as written, NaN at vertices without; None if no vertex has a colour
    colors: np.ndarray | None
    uv: np.ndarray  # float64 [T, 2]
    faces: np.ndarray  # int32 [F, 3]
    uv_faces: np.ndarray  # int32 [F, 3]; -1, -1, -1 at a face without texture coordinates
    face_material: np.ndarray  # int32 [F], index in `materials`
    materials: list[str]  # the name of each line `usemtl`; "" first, for the faces before
    libraries: list[str]  # the names of each line `mtllib`


def load(filename: str, with_uv: bool = True) -> Obj:
    """`read_obj` of a file. Raises ValueError, with the file's name, also if it has no face."""
    with _open(filename) as file:
        try:
            obj = read_obj(file, with_uv)
        except ValueError as error:
            raise ValueError(f"{filename}, {error}") from None
    if not len(obj.faces):
        missing = "faces (lines `f 1 2 3`)" if len(obj.vertices) else "vertices (lines `v x y z`)"
        raise ValueError(f"{filename} has no {missing}")
    return obj


def _open(filename: str) -> BinaryIO:
    """Open an OBJ or MTL file. Raises ValueError for pipes (reading one would wait) and files
    above 1 GiB.
    """
    if os.path.exists(filename) and not os.path.isfile(filename):
        raise ValueError(f"{filename} is not a regular file")
    if os.path.exists(filename) and os.path.getsize(filename) > _MOST_BYTES:
        raise ValueError(
            f"{filename} has {os.path.getsize(filename)} bytes; at most {_MOST_BYTES} are read"
        )
    return open(filename, "rb")


def read_obj(file: BinaryIO, with_uv: bool = True) -> Obj:
    """Read an OBJ file; `triangulate` cuts its polygons.

    Points, lines, groups, normals and unknown lines are skipped. Lines may be indented, have
    comments, be continued by a backslash, and end as on any system. A face needs texture
    coordinates at all corners to have any. If there is no line `vt`, no face has any. It takes
    the memory of the result twice, and some megabytes.

    with_uv: False skips texture coordinates. Raises ValueError, with the number of the line, if a
    line cannot be read or a face refers to a missing element.
    """
    lines, rest, number = _Lines(with_uv), b"", 1
    while True:
        more = file.read(max(_CHUNK, len(rest)))
        text = rest + more
        if number == 1:
            text = text.removeprefix(b"\xef\xbb\xbf")
            if text[:2] in (b"\xff\xfe", b"\xfe\xff"):
                raise ValueError("it is UTF-16; save it as UTF-8")
        end = _last_line_end(text) if more else len(text)
        text, rest = text[:end], text[end:]
        # Every replacement is as long as what it replaces. Where a backslash continues a line, a
        # vertical tab replaces the line end.
        if b"\r" in text:
            text = text.replace(b"\r\n", b" \n").replace(b"\r", b"\n")
        if b"\\" in text:
            text = re.sub(rb"(?m)^([^#\n]*)\\( ?)\n", rb"\1 \2\v", text)
        lines.take(text if text.endswith(b"\n") else text.rstrip(b"\0") + b"\n", number)
        number += _count_lines(text)
        if not more:
            return lines.joined()


def _last_line_end(text: bytes) -> int:
    """The end of the last complete line, 0 if there is none. Lone carriage returns end lines if
    no other line ends.
    """
    end = text.rfind(b"\n") + 1 or text.rfind(b"\r", 0, len(text) - 1) + 1
    while text[max(end - 3, 0) : end].rstrip(b"\r\n").endswith(b"\\"):
        end = text.rfind(b"\n", 0, end - 1) + 1
    return end


def _count_lines(text: bytes) -> int:
    return text.count(b"\n") + text.count(b"\v")


class _Lines:
    """The elements of the lines so far."""

    def __init__(self, with_uv: bool) -> None:
        self.with_uv = with_uv
        self.vertices, self.colors, self.uv = [], [], []  # arrays of each chunk
        self.corners, self.uv_corners, self.sizes = [], [], []
        self.num_vertices = self.num_uv = self.num_polygons = 0
        self.materials, self.first_polygons, self.libraries = [""], [0], []
        self.largest = {
            "vertex": (-1, ""),
            "texture coordinate": (-1, ""),
        }  # index of a corner, and its line

    def take(self, text: bytes, number: int) -> None:
        """Add complete lines, which count from `number`. The first wrong one is found by
        bisection.
        """
        try:
            self._parse(text, number)
        except (ValueError, OverflowError) as error:
            plain = _WORDS.sub(rb"\1", text)
            if plain != text:
                return self.take(plain, number)
            half = len(text) // 2
            end = text.find(b"\n", half, len(text) - 1) + 1 or text.rfind(b"\n", 0, half) + 1
            if end == 0:
                raise ValueError(f"line {number}: {_shown(text)} cannot be read: {error}") from None
            self.take(text[:end], number)
            self.take(text[end:], number + _count_lines(text[:end]))

    def _parse(self, text: bytes, number: int) -> None:
        plain = (
            re.sub(rb"#[^\n]*", lambda comment: b" " * len(comment[0]), text)
            if b"#" in text
            else text
        )
        content = np.frombuffer(plain, np.uint8)
        gap = _is_gap(content)
        ends = np.flatnonzero(content == ord("\n"))
        words = _starts(~gap)
        rows = np.searchsorted(ends, words)
        first = np.flatnonzero(np.diff(rows, prepend=-1))  # the words that begin a line
        keys, rows = words[first], rows[first]
        counts = np.diff(first, append=len(words)) - 1  # words behind the keyword
        # in lower case
        a, b, _ = (content[np.minimum(keys + i, len(content) - 1)] | 32 for i in range(3))
        one, two = (gap[np.minimum(keys + i, len(content) - 1)] for i in (1, 2))
        is_vertex = (a == ord("v")) & one
        is_uv = (a == ord("v")) & (b == ord("t")) & two & self.with_uv
        is_face = (a == ord("f")) & (one | ((b == ord("o")) & two))

        def behind_keywords(chosen: np.ndarray) -> np.ndarray:
            """The bytes of these lines, with blanks for the first two of each."""
            line_chosen = np.zeros(len(ends), bool)
            line_chosen[rows[chosen]] = True
            blank = content.copy()
            blank[keys[chosen]] = blank[keys[chosen] + 1] = ord(" ")
            return blank[np.repeat(line_chosen, np.diff(ends, prepend=-1))]

        width = 6 if (counts[is_vertex] > 5).any() else 3
        vertices = _table(behind_keywords(is_vertex), counts[is_vertex], 3, 3, width)
        uv = _table(behind_keywords(is_uv), counts[is_uv], 1, 2, 2)
        sizes, before = counts[is_face], (np.cumsum(is_vertex)[is_face], np.cumsum(is_uv)[is_face])
        corners = _corners(behind_keywords(is_face), sizes)
        corners[1] *= self.with_uv
        for k, (name, total) in enumerate(
            zip(self.largest, (self.num_vertices, self.num_uv), strict=True)
        ):
            corners[k] = _absolute(corners[k], np.repeat(total + before[k], sizes), optional=k == 1)
            at = int(corners[k].argmax()) if len(corners[k]) else 0
            if len(corners[k]) and corners[k][at] > self.largest[name][0]:
                row = rows[is_face][np.searchsorted(np.cumsum(sizes), at, "right")]
                line = text[ends[row - 1] + 1 if row else 0 : ends[row] + 1]
                where = number + _count_lines(text[: ends[row]])
                self.largest[name] = (int(corners[k][at]), f"line {where}: {_shown(line)}")
        for i in np.flatnonzero((a == ord("u")) | (a == ord("m"))):
            keyword, rest = _keyword(text[keys[i] : ends[rows[i]]].decode("utf-8", "replace"))
            if keyword == "usemtl":
                self.materials.append(_without_comment(rest))
                self.first_polygons.append(self.num_polygons + int(is_face[:i].sum()))
            elif keyword == "mtllib":
                self.libraries.append(rest)
        self.vertices.append(vertices[:, :3])
        self.colors.append(vertices[:, 3:].copy())
        self.uv.append(uv)
        self.corners.append(corners[0].astype(np.int32))
        self.uv_corners.append(corners[1].astype(np.int32))
        self.sizes.append(sizes.astype(np.int32))
        self.num_vertices += len(vertices)
        self.num_uv += len(uv)
        self.num_polygons += len(sizes)

    def joined(self) -> Obj:
        for name, count in (("vertex", self.num_vertices), ("texture coordinate", self.num_uv)):
            index, line = self.largest[name]
            if index >= count and (name == "vertex" or count):
                raise ValueError(
                    f"{line} cannot be read: it refers to {name} {index + 1}, but there are {count}"
                )
        has_colors = any(part.shape[1] for part in self.colors)
        colors = [
            part if part.shape[1] else np.full((len(part), 3), np.nan)
            for part in self.colors
            if has_colors
        ]
        vertices, uv = _joined(self.vertices, 3), _joined(self.uv, 2)
        corners, uv_corners, sizes = (
            _joined(parts, 1)[:, 0] for parts in (self.corners, self.uv_corners, self.sizes)
        )
        if (sizes == 3).all():
            faces, uv_faces = corners.reshape(-1, 3), uv_corners.reshape(-1, 3)
        else:
            triangles = triangulate(vertices, corners, sizes)
            faces, uv_faces = corners[triangles], uv_corners[triangles]
        uv_faces[(uv_faces < 0).any(axis=1) | (self.num_uv == 0)] = -1
        runs = np.diff(self.first_polygons, append=self.num_polygons)
        of_polygon = np.repeat(np.arange(len(runs), dtype=np.int32), runs)
        of_face = np.repeat(of_polygon, np.maximum(sizes - 2, 0))
        found = _joined(colors, 3) if has_colors else None
        return Obj(vertices, found, uv, faces, uv_faces, of_face, self.materials, self.libraries)


def _joined(parts: list[np.ndarray], width: int) -> np.ndarray:
    """The rows of all parts, which are forgotten."""
    joined = np.concatenate(parts).reshape(-1, width)
    parts.clear()
    return joined


def _shown(line: bytes) -> str:
    return repr(line.decode("utf-8", "replace").strip()[:200])


def _is_gap(content: np.ndarray) -> np.ndarray:
    """Which bytes are white space."""
    return (content == ord(" ")) | ((content >= ord("\t")) & (content <= ord("\r")))


def _starts(inside: np.ndarray) -> np.ndarray:
    """The first index of each run of True."""
    return np.flatnonzero(inside & ~np.concatenate([[False], inside[:-1]]))


def _numbers(data: np.ndarray, dtype: type, count: int, wanted: str) -> np.ndarray:
    """The numbers of a text. Raises ValueError(wanted) if there are others than `count`."""
    try:
        values = np.fromstring(data.tobytes(), dtype=dtype, sep=" ")
    except ValueError:
        values = np.empty(0)
    if len(values) != count:
        raise ValueError(wanted)
    return values


def _table(data: np.ndarray, counts: np.ndarray, least: int, needed: int, width: int) -> np.ndarray:
    """The first numbers of each line, float64 [N, width].

    A missing number is 0 in the first `needed` columns, else NaN. Raises ValueError for lines of
    fewer than `least` numbers, and if one of the needed ones is not finite in float32.
    """
    wanted = f"{needed} numbers are needed, finite in float32"
    if not len(counts):
        return np.empty((0, width))
    values = _numbers(data, np.float64, counts.sum(), wanted)
    column = np.arange(width)
    index = (np.cumsum(counts) - counts)[:, None] + column
    missing = np.where(column < needed, 0, np.nan)
    table = np.where(column < counts[:, None], values[np.minimum(index, len(values) - 1)], missing)
    if counts.min() < least or not (np.abs(table[:, :needed]) <= _LARGEST).all():
        raise ValueError(wanted)
    return table


def _corners(data: np.ndarray, sizes: np.ndarray) -> list[np.ndarray]:
    """The numbers of the vertices and of the texture coordinates (0 if missing) of all corners,
    int64 [N] each.
    """
    wanted, count = "corners such as 1, 1/2, 1//3 or 1/2/3 are needed", int(sizes.sum())
    if len(sizes) and sizes.min() == 0:
        raise ValueError("a face needs corners")
    slash, gap = data == ord("/"), _is_gap(data)
    starts = _starts(~(slash | gap))
    numbers = _numbers(np.where(slash, np.uint8(ord(" ")), data), np.int64, len(starts), wanted)
    if not slash.any():
        return [numbers, np.zeros(count, np.int64)]
    slashes, corners = np.cumsum(slash, dtype=np.int32), _starts(~gap)
    corner = np.searchsorted(corners, starts, "right") - 1
    place = slashes[starts] - (slashes[corners] - slash[corners])[corner]
    if np.count_nonzero(place == 0) != count:
        raise ValueError(wanted)
    uv = np.zeros(count, np.int64)
    uv[corner[place == 1]] = numbers[place == 1]
    return [numbers[place == 0], uv]


def _absolute(numbers: np.ndarray, before: np.ndarray, optional: bool) -> np.ndarray:
    """Indices from 0; -1 for the number 0 if it is optional. Negative numbers count back from the
    elements before.
    """
    indices = np.where(numbers > 0, numbers - 1, numbers + before)
    missing = numbers == 0
    indices[missing] = -1
    wrong = (indices < 0) & ~(missing & optional)
    if wrong.any():
        raise ValueError(f"there is no element {numbers[wrong][0]}")
    return np.minimum(indices, 2**31 - 1)


def triangulate(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Cut simple polygons, convex or not, into triangles.

    A polygon becomes the fan around its first corner whose triangles do not fold over: for convex
    polygons, corner 0. If every fan around its first eight corners folds, the polygon is cut by
    its ears.

    Parameters
    ----------
    vertices : float64 [V, 3]
    corners : integers [N]
        Vertices of the first polygon, then of the second, and so on.
    sizes : integers [P]
        Number of corners of each polygon. Those of one or two corners give no triangle.

    Returns
    -------
    int32 [T, 3]
        Indices in `corners`. Polygon i gives ``sizes[i] - 2`` consecutive rows, in the order of
        the polygons, with its winding.

    Raises
    ------
    ValueError
        If a corner is outside of the vertices, and for polygons of over 4096 corners that are no
        fan.
    """
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        raise ValueError(f"a polygon refers to a missing vertex; there are {len(vertices)}")
    if (sizes == 3).all():
        return np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    rows, starts = np.maximum(sizes - 2, 0), np.cumsum(sizes) - sizes
    first_rows = np.cumsum(rows) - rows
    triangles = np.empty((int(rows.sum()), 3), np.int32)
    order = np.argsort(sizes, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(sizes[order])) + 1):
        size = int(sizes[group[0]]) if len(group) else 0
        for part in np.array_split(group, 1 + len(group) * size // 2**17) if size > 2 else ():
            at = starts[part][:, None]
            cut = _cut(vertices[corners[at + np.arange(size)]]) if size > 3 else np.arange(3)
            triangles[first_rows[part][:, None] + np.arange(size - 2)] = at[:, None] + cut
    return triangles


def _cut(points: np.ndarray) -> np.ndarray:
    """The triangles int64 [P, N - 2, 3] of polygons [P, N, 3]."""
    count, size = points.shape[:2]
    fan = np.stack(
        [np.zeros(size - 2, np.int32), np.arange(1, size - 1), np.arange(2, size)],
        axis=1,
        dtype=np.int32,
    )
    triangles = np.repeat(fan[None], count, axis=0)
    left = np.arange(count)
    for shift in range(min(size, 8)):
        turned = np.roll(points[left], -shift, axis=1)
        turned -= turned[:, :1].copy()
        # their sum is Newell's normal, right for concave polygons
        areas = np.cross(turned[:, 1:-1], turned[:, 2:])
        folded = (np.einsum("pij,pj->pi", areas, areas.sum(axis=1)) < 0).any(axis=1)
        triangles[left[~folded]] = (fan + shift) % size
        left = left[folded]
        if not len(left):
            break
    for polygon in left:
        triangles[polygon] = _cut_ears(points[polygon])
    return triangles


def _cut_ears(points: np.ndarray) -> list[tuple[int, int, int]]:
    """N - 2 triangles of a polygon [N, 3], by ear clipping in the coordinate plane of its largest
    projection.
    """
    size = len(points)
    if size > _MOST_EARS:
        raise ValueError(
            f"a polygon of {size} corners is not convex; at most {_MOST_EARS} are cut into triangles"
        )
    points = points - points[0]
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    u, v = (axis + 1) % 3, (axis + 2) % 3
    flat = points[:, [u, v] if normal[axis] >= 0 else [v, u]].tolist()  # counter-clockwise
    before, after = [*range(-1, size - 1)], [*range(1, size), 0]
    before[0] = size - 1

    def turn(a: list[float], b: list[float], c: list[float]) -> float:
        """Twice the signed area of a triangle: positive if c is left of the line from a to b."""
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    def angle(j: int) -> float:
        return turn(flat[before[j]], flat[j], flat[after[j]])

    def is_ear(j: int) -> bool:
        a, b, c = flat[before[j]], flat[j], flat[after[j]]
        others = (flat[i] for i in reflex)  # if any corner lies in the triangle, a reflex one does
        inside = (p for p in others if turn(a, b, p) >= 0 <= turn(b, c, p) and turn(c, a, p) >= 0)
        return all(p in (a, b, c) for p in inside)

    reflex = {j for j in range(size) if angle(j) <= 0}
    triangles, j, misses, crosses = [], 0, 0, False
    while len(triangles) < size - 2:
        left = size - len(triangles)
        # Without an ear, corners without area go first. A polygon that crosses itself is cut
        # anyhow.
        crosses = crosses or misses > 2 * left
        if crosses or (misses > left and angle(j) == 0) or (angle(j) > 0 and is_ear(j)):
            triangles.append((before[j], j, after[j]))
            after[before[j]], before[after[j]] = after[j], before[j]
            reflex.discard(j)
            for side in (before[j], after[j]):
                (reflex.add if angle(side) <= 0 else reflex.discard)(side)
            misses = 0
        else:
            misses += 1
        j = after[j]
    return triangles


def _keyword(line: str) -> tuple[str, str]:
    """The first word of a line, in lower case, and the rest."""
    keyword, *rest = line.split(None, 1) or [""]
    return keyword.lower(), rest[0].rstrip() if rest else ""


def _without_comment(text: str) -> str:
    """``text`` before a ``#`` that begins a word; names may hold one inside."""
    return re.split(r"(?:^|\s)#", text, maxsplit=1)[0].rstrip()


def read_mtl(filename: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Colours ``Kd`` float32 [3] and image names ``map_Kd`` (as written) of the materials of an
    MTL file.

    Raises ValueError, with the number of the line, for a colour that cannot be read.
    """
    colors, images, material = {}, {}, ""
    with _open(filename) as file:
        content = file.read().decode("utf-8-sig", "replace")
    for number, line in enumerate(content.splitlines(), 1):
        keyword, rest = _keyword(line)
        if keyword == "newmtl":
            material = _without_comment(rest)
        elif keyword == "map_kd":
            images[material] = rest
        elif keyword == "kd":
            words = _without_comment(rest).split()[:3]
            try:
                data = np.frombuffer(" ".join(words).encode(), np.uint8)
                colors[material] = _table(data, np.array([len(words)]), 3, 3, 3)[0].astype(
                    np.float32
                )
            except ValueError as error:
                raise ValueError(
                    f"{filename}, line {number}: {_shown(line.encode())} cannot be read: {error}"
                ) from None
    return colors, images


def find_libraries(folder: str, lines: Iterable[str]) -> list[str]:
    """The MTL files of lines ``mtllib``, each of one name with spaces, or of several. Missing
    ones are listed, too.
    """
    found = []
    for line in lines:
        whole = [path for name in (line, _without_comment(line)) if (path := _find(folder, name))]
        words = _without_comment(line).split()
        found += whole[:1] or [_find(folder, word) or os.path.join(folder, word) for word in words]
    return found


def find_image(folder: str, line: str) -> str:
    """The file of a line ``map_Kd``; if it is missing, the path of its name.

    Options may come before the name, a comment after it, quotes around it, and spaces in it.
    """
    names = [re.sub("^" + _OPTIONS, "", text) for text in (line, _without_comment(line))]
    names = [line, *names, (names[1].split() or [""])[-1]]
    return next(
        (path for name in names if (path := _find(folder, name))), os.path.join(folder, names[2])
    )


def _find(folder: str, name: str) -> str | None:
    """The file `name` below a folder, or None.

    Backslashes and another case of the letters are accepted. Of a path that does not exist the
    last part counts: it may be one of another machine.
    """
    name = name.strip().strip("\"'").replace("\\", "/")
    if os.path.isfile(path := os.path.join(folder, name)):
        return path
    for tail in (name, name.rpartition("/")[2]):
        path = folder or "."
        for part in tail.split("/"):
            there = os.listdir(path) if os.path.isdir(path) else []
            same = [one for one in there if one.lower() == part.lower()]
            path = os.path.join(path, part if part in there or not same else min(same))
        if tail and os.path.isfile(path):
            return path
    return None


def match_materials(
    names: list[str], face_material: np.ndarray, known: Collection[str], filename: str
) -> list[str]:
    """The material of each name of a line `usemtl`: itself, or its first word (as published); ""
    if neither is known.

    Warns of faces without a known material.
    """
    firsts = [(name.split() or [""])[0] for name in names]
    matched = [
        next((one for one in pair if one in known), "") for pair in zip(names, firsts, strict=True)
    ]
    unknown = np.array([name == "" for name in matched])[face_material]
    if unknown.any():
        missing = {names[i] for i in np.unique(face_material[unknown])}
        named = ", ".join(repr(name[:60]) for name in sorted(missing - {""})[:3])
        why = (
            f"their materials ({named}) are in no library"
            if named
            else "no line `usemtl` gives them a material"
        )
        warnings.warn(
            f"{filename}: {int(unknown.sum())} of {len(unknown)} faces stay grey, for {why}; "
            f"the libraries have {', '.join(repr(name[:60]) for name in list(known)[:5]) or 'no materials'}",
            stacklevel=3,
        )
    return matched
