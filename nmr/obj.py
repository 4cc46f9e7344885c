"""Wavefront OBJ and MTL files, and polygons cut into triangles. Does not import torch, for
processes without it.
"""

from __future__ import annotations

import os
import re
import warnings
from array import array
from collections.abc import Collection, Iterable
from typing import BinaryIO, NamedTuple

import numpy as np

_MOST_BYTES = 2**30  # limit of an .obj or .mtl file
_LARGEST = float(np.finfo(np.float32).max)
_OPTIONS = r"(?:-(?:[sot](?:\s+[-+.\d][-+.\deE]*){1,3}|mm\s+\S+\s+\S+|[a-zA-Z]+\s+\S+)\s+)*"  # of a line `map_Kd`


def _alike(keyword: str, word: str, count: int) -> str:
    """A pattern for up to 4096 lines of a keyword and `count` words."""
    return rf"((?:{keyword}(?:[ \t]+{word}){{{count}}}[ \t]*\n){{1,4096}})"


# Lines of one kind that NumPy reads at once, as most programs write them.
_NUMBER, _INDEX = r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?", r"[1-9]\d{0,8}"
_CORNERS = [_INDEX, f"{_INDEX}/{_INDEX}", f"{_INDEX}//{_INDEX}", f"{_INDEX}/{_INDEX}/{_INDEX}"]
_BLOCK = re.compile(
    "|".join(
        [_alike("v", _NUMBER, 3), _alike("vt", _NUMBER, 2)]
        + [_alike("f", corner, size) for size in (3, 4) for corner in _CORNERS]
        + [r"(?:(?:(?:vn|[gos])[ \t]|#)[^\n]*\n)+"]
    ).encode()
)
_TO_BLANKS = bytes.maketrans(b"vtf/", b"    ")


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
    coordinates at all corners to have any. If there is no line `vt`, no face has any.

    with_uv: False skips texture coordinates. Raises ValueError, with the number of the line, if a
    line cannot be read or a face refers to a missing element.
    """
    text = file.read().removeprefix(b"\xef\xbb\xbf")
    if text[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise ValueError("it is UTF-16; save it as UTF-8")
    text = text.rstrip(b"\0").replace(b"\r\n", b"\n").replace(b"\r", b"\n") + b"\n"
    if b"\\" in text:  # a vertical tab replaces a line end, so that lines can be counted
        text = re.sub(rb"(?m)^([^#\n]*)\\ ?\n", rb"\1 \v", text)
    elements = _Elements(with_uv)
    elements.read(text)
    if elements.have_faults():  # of lines that were read at once
        _Elements(with_uv, (len(elements.vertices) // 3, len(elements.uv) // 2)).read(text)
    return elements.joined()


class _Elements:
    """The elements of the lines so far. counts: numbers of vertices and of texture coordinates of
    the text; None if not known yet. With them each line is read by itself, and the first one at
    fault is named.
    """

    def __init__(self, with_uv: bool, counts: tuple[int, int] | None = None) -> None:
        self.with_uv, self.counts = with_uv, counts
        self.vertices, self.colors, self.uv = array("d"), array("d"), array("d")
        self.corners, self.uv_corners, self.sizes = array("q"), array("q"), array("q")
        self.materials, self.first_polygons, self.libraries = [""], [0], []

    def read(self, text: bytes) -> None:
        at = 0
        while at < len(text):
            block = None if self.counts else _BLOCK.match(text, at)
            if block:
                self._take_block(block)
                at = block.end()
                continue
            end = text.index(b"\n", at)
            try:
                self._take_line(text[at:end])
            except (ValueError, OverflowError) as error:
                number = 1 + text.count(b"\n", 0, at) + text.count(b"\v", 0, at)
                shown = repr(text[at:end].decode("utf-8", "replace").strip()[:200])
                raise ValueError(f"line {number}: {shown} cannot be read: {error}") from None
            at = end + 1

    def _take_block(self, block: re.Match[bytes]) -> None:
        kind = (block.lastindex or 0) - 1
        if kind < 0:
            return
        dtype = np.float64 if kind < 2 else np.int64
        numbers = np.fromstring(block[0].translate(_TO_BLANKS), dtype, sep=" ")
        if kind == 0:
            self.vertices.frombytes(numbers.tobytes())
        elif kind == 1:
            self.uv.frombytes(numbers.tobytes() if self.with_uv else b"")
        else:
            size, form = divmod(kind - 2, len(_CORNERS))
            corners = numbers.reshape(-1, 1 + (form > 0) + (form > 2)) - 1
            has_uv = self.with_uv and form in (1, 3)
            uv = corners[:, 1] if has_uv else np.full(len(corners), -1)
            self.corners.frombytes(corners[:, 0].tobytes())
            self.uv_corners.frombytes(uv.tobytes())
            self.sizes.frombytes(np.full(len(corners) // (3 + size), 3 + size).tobytes())

    def _take_line(self, line: bytes) -> None:
        keyword, *words = line.partition(b"#")[0].split() or [b""]
        keyword = keyword.lower()
        if keyword == b"v":
            self._take_color(words[3:])
            self.vertices.extend(_numbers(words, 3, 3))
        elif keyword == b"vt" and self.with_uv:
            self.uv.extend(_numbers(words, 1, 2))
        elif keyword in (b"f", b"fo"):
            self._take_face(words)
        elif keyword in (b"usemtl", b"mtllib"):
            _, name = _keyword(line.decode("utf-8", "replace"))
            if keyword == b"mtllib":
                self.libraries.append(name)
            else:
                self.materials.append(_without_comment(name))
                self.first_polygons.append(len(self.sizes))

    def _take_color(self, words: list[bytes]) -> None:
        """The colour of the next vertex, if the words begin with three numbers."""
        try:
            color = [float(word) for word in words[:3]]
        except ValueError:
            return
        if len(color) == 3:
            self.colors.extend([np.nan] * (len(self.vertices) - len(self.colors)) + color)

    def _take_face(self, words: list[bytes]) -> None:
        if not words:
            raise ValueError("a face needs corners")
        for word in words:
            try:
                vertex, uv, *_ = [int(part or 0) for part in word.split(b"/")] + [0]
            except ValueError:
                vertex = None
            if vertex is None or word.startswith(b"/"):
                raise ValueError("corners such as 1, 1/2, 1//3 or 1/2/3 are needed")
            self.corners.append(self._index("vertex", vertex, len(self.vertices) // 3))
            uv = (
                self._index("texture coordinate", uv, len(self.uv) // 2)
                if uv and self.with_uv
                else -1
            )
            self.uv_corners.append(uv)
        self.sizes.append(len(words))

    def _index(self, name: str, number: int, before: int) -> int:
        """The index from 0 of an element. Negative numbers count back from the elements before."""
        index = number - 1 if number > 0 else number + before
        if number == 0 or index < 0:
            raise ValueError(f"there is no element {number}")
        count = self.counts[name != "vertex"] if self.counts else None
        if count is not None and index >= count and (count or name == "vertex"):
            raise ValueError(f"it refers to {name} {number}, but there are {count}")
        return index

    def have_faults(self) -> bool:
        """Whether an element is missing, or too large for float32."""
        num_vertices, num_uv = len(self.vertices) // 3, len(self.uv) // 2
        return (
            max(self.corners, default=-1) >= num_vertices
            or max(self.uv_corners, default=-1) >= (num_uv or np.inf)
            or any(np.abs(values).max(initial=0) > _LARGEST for values in (self.vertices, self.uv))
        )

    def joined(self) -> Obj:
        vertices, uv = np.array(self.vertices).reshape(-1, 3), np.array(self.uv).reshape(-1, 2)
        corners, sizes = np.array(self.corners), np.array(self.sizes)
        triangles = triangulate(vertices, corners, sizes)
        uv_faces = np.array(self.uv_corners, np.int32)[triangles]
        uv_faces[(uv_faces < 0).any(axis=1) | (len(uv) == 0)] = -1
        polygons = np.searchsorted(np.cumsum(sizes), triangles[:, 0], "right")
        materials = np.searchsorted(self.first_polygons, polygons, "right") - 1
        colors = None
        if self.colors:
            colors = np.full(len(vertices) * 3, np.nan)
            colors[: len(self.colors)] = self.colors
            colors = colors.reshape(-1, 3)
        return Obj(
            vertices,
            colors,
            uv,
            corners[triangles].astype(np.int32),
            uv_faces,
            materials.astype(np.int32),
            self.materials,
            self.libraries,
        )


def _numbers(words: list[bytes], least: int, needed: int) -> list[float]:
    """The first `needed` numbers of a line, 0 for missing ones. Raises ValueError for fewer than
    `least`.
    """
    try:
        values = [float(word) for word in words[:needed]]
    except ValueError:
        values = []
    if len(values) < least or not all(abs(value) <= _LARGEST for value in values):
        raise ValueError(f"{needed} numbers are needed, finite in float32")
    return values + [0.0] * (needed - len(values))


def triangulate(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Cut simple polygons, convex or not, into triangles.

    A polygon becomes the fan around its first corner. If a triangle of the fan folds over, as in
    concave polygons, Mapbox's earcut cuts the polygon, and leaves out corners on a straight side.

    Parameters
    ----------
    vertices : float64 [V, 3]
    corners : integers [N]
        Vertices of the first polygon, then of the second, and so on.
    sizes : integers [P]
        Number of corners of each polygon. Those of one or two corners give no triangle.

    Returns
    -------
    integers [T, 3]
        Indices in `corners`, in the order of the polygons, with their winding.

    Raises
    ------
    ValueError
        If a corner is outside of the vertices.
    """
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        raise ValueError(f"a polygon refers to a missing vertex; there are {len(vertices)}")
    rows, ends = np.maximum(sizes - 2, 0), np.cumsum(sizes)
    polygon = np.repeat(np.arange(len(sizes)), rows)
    first = (ends - sizes)[polygon]
    last = first + 2 + np.arange(len(polygon)) - (np.cumsum(rows) - rows)[polygon]
    fans = np.stack([first, last - 1, last], axis=1)
    if (rows <= 1).all():
        return fans
    a, b, c = (vertices[corners[fans[:, k]]] for k in range(3))
    areas = np.cross(b - a, c - a)
    # their sum is Newell's normal, right for concave polygons
    normals = np.stack([np.bincount(polygon, areas[:, k], len(sizes)) for k in range(3)], axis=1)
    is_folded = np.zeros(len(sizes), bool)
    is_folded[polygon[np.einsum("ij,ij->i", areas, normals[polygon]) < 0]] = True
    triangles = [fans[~is_folded[polygon]]]
    for k in np.flatnonzero(is_folded):
        inside = slice(ends[k] - sizes[k], ends[k])
        triangles.append(inside.start + _cut_concave(vertices[corners[inside]], normals[k]))
    triangles = np.concatenate(triangles)
    return triangles[np.argsort(np.searchsorted(ends, triangles[:, 0], "right"), kind="stable")]


def _cut_concave(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles [T, 3] of a polygon [N, 3], in the coordinate plane of its largest projection."""
    from mapbox_earcut import triangulate_float64

    axis = int(np.abs(normal).argmax())
    flat = (points - points[0])[:, [(axis + 1) % 3, (axis + 2) % 3]]
    found = triangulate_float64(flat, np.array([len(flat)], np.uint32)).reshape(-1, 3)
    # they are counter-clockwise whichever way the polygon runs
    return (found if normal[axis] >= 0 else found[:, ::-1]).astype(np.int64)


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
            words = _without_comment(rest).split()
            try:
                colors[material] = np.float32(_numbers(words, 3, 3))
            except ValueError as error:
                raise ValueError(
                    f"{filename}, line {number}: {line.strip()[:200]!r} cannot be read: {error}"
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
