"""Reads OFF, PLY and STL files: the corners and triangles of their content.

Each reader takes the bytes of a file and returns vertices float64 [V, 3] and faces [F, 3]. It
raises EOFError if the file is cut short, and ValueError or another error if it is wrong.
"""

import re

import numpy as np

from nmr.obj import triangulate

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_NUMBER = rb"[-+]?(?:[\d.][-+.\de]*|nan|inf\w*)"
_STL_VERTEX = re.compile(rb"\bvertex\s+(%b\s+%b\s+%b)(?!\S)" % (3 * (_NUMBER,)))
Triangles = tuple[np.ndarray, np.ndarray]
_PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
}
_PLY_TYPES |= {
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
}
_PLY_TYPES |= {"uint32": "u4", "float32": "f4", "float64": "f8"}
_PLY_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def read_stl(content: bytes) -> Triangles:
    """Read an STL file, binary (bytes behind the last triangle are ignored) or text.

    A text begins with `solid`, and has no zero where a binary file has the high byte of its count
    or its first triangle.
    """
    text = content.removeprefix(_BYTE_ORDER_MARK).lower()
    if text.lstrip()[:5] == b"solid" and b"\0" not in content[:134]:
        found = list(_STL_VERTEX.finditer(text))
        facets = len(re.findall(rb"\bend\s*facet\b", text))
        ends = [match.start() for match in re.finditer(rb"\bend\s*solid\b", text)]
        if found and max(ends, default=0) < found[-1].start():
            raise EOFError("its last solid does not end")
        if len(found) != 3 * facets:
            raise ValueError(
                f"it has {facets} facets and {len(found)} corners; each facet needs three"
            )
        corners = np.fromstring(b" ".join(match[1] for match in found), sep=" ")
    else:
        count, rest = int.from_bytes(content[80:84], "little"), len(content) - 84
        if count in (0, 2**32 - 1) and rest > 0 and rest % 50 == 0:  # not known when it was begun
            count = rest // 50
        if rest < 50 * count or rest < 0:
            raise EOFError(
                f"it has {len(content)} bytes; its header promises {count} triangles of 50"
            )
        rows = np.frombuffer(content, "u1", 50 * count, 84).reshape(count, 50)
        corners = rows[:, 12:48].copy().view("<f4")
    corners = corners.reshape(-1, 3).astype(np.float64)
    return corners, np.arange(len(corners)).reshape(-1, 3)


def read_off(content: bytes) -> Triangles:
    """Read an OFF file, also with colours, normals or texture coordinates behind the corners, or
    with its counts glued to the first word, as in ModelNet40.
    """
    text = re.sub(rb"#[^\r\n]*", b"", content.removeprefix(_BYTE_ORDER_MARK))
    head = re.match(rb"(?i)\s*((?:ST)?C?N?OFF)(?=[\s\d])(?!\s+BINARY)", text)
    if head is None:
        raise ValueError("it does not begin with OFF (or COFF, NOFF, STOFF), as a text file does")
    lines = [line for line in text[head.end() :].splitlines() if line.strip()]
    counts = lines[0].split() if lines else []
    if len(counts) < 2:
        raise EOFError("it ends before its counts of corners and faces")
    num_vertices, num_faces = int(counts[0]), int(counts[1])
    rows = lines[1 : 1 + num_vertices + num_faces]
    if len(rows) < num_vertices + num_faces and head[1].upper() == b"OFF":
        rows = _off_rows(b" ".join(lines).split()[3:], num_vertices, num_faces)
    if len(rows) < num_vertices + num_faces:
        raise EOFError(
            f"it has {len(rows)} lines; its header promises {num_vertices} corners and {num_faces} faces"
        )
    vertices = np.array([line.split()[:3] for line in rows[:num_vertices]], np.float64).reshape(
        -1, 3
    )
    sizes, corners = [], []
    for line in rows[num_vertices:]:
        size, *words = line.split()
        sizes.append(int(size))
        corners += [int(word) for word in words[: sizes[-1]]]
    return _cut(vertices, np.array(corners, np.int64), np.array(sizes, np.int64))


def _off_rows(words: list[bytes], num_vertices: int, num_faces: int) -> list[bytes]:
    """The words of a plain OFF file as rows of a corner or a face, as far as they go."""
    at = 0
    rows = []
    while len(rows) < num_vertices + num_faces and at < len(words):
        size = 3 if len(rows) < num_vertices else 1 + int(words[at])
        if at + size > len(words):
            break
        rows.append(b" ".join(words[at : at + size]))
        at += size
    return rows


def read_ply(content: bytes) -> Triangles:
    """Read a PLY file: the elements `vertex` and `face`; others are skipped."""
    content = content.removeprefix(_BYTE_ORDER_MARK)
    if not content.startswith(b"ply"):
        raise ValueError("it does not begin with the line `ply`")
    header = re.match(rb".*?[\r\n]end_header[ \t]*(?:\r\n|\n|\r)", content, re.DOTALL)
    if header is None:
        raise EOFError("its header does not end")
    kind = ""
    elements = []
    for line in header[0].decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            kind = words[1]
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            types = [_PLY_TYPES[word] for word in words[1:-1] if word != "list"]
            elements[-1][2].append((words[-1], ["f8"] * len(types) if kind == "ascii" else types))
    body = content[header.end() :]
    if kind == "ascii":  # as a binary file of doubles
        try:
            numbers = np.fromstring(body, sep=" ")
        except ValueError:  # the last number may be cut in two
            numbers = np.fromstring(b" ".join(body.rsplit(None, 1)[:-1]), sep=" ")
        body = numbers.tobytes()
    vertices = np.empty((0, 3))
    corners = np.empty(0, np.int64)
    sizes = np.empty(0, np.int64)
    at = 0
    for name, count, properties in elements:
        if name == "tristrips" and count:
            raise ValueError("it has triangle strips (element tristrips); save it with triangles")
        columns = [
            (one, [np.dtype(_PLY_ORDERS[kind] + each) for each in types])
            for one, types in properties
        ]
        found, at = _ply_element(body, at, name, count, columns)
        if name == "vertex":
            vertices = np.stack([found[axis][0] for axis in "xyz"], axis=1).astype(np.float64)
        elif name == "face":
            values, sizes = found["vertex_indices" if "vertex_indices" in found else "vertex_index"]
            corners = values.astype(np.int64)
    return _cut(vertices, corners, sizes)


def _ply_element(
    body: bytes, start: int, name: str, count: int, columns: list[tuple[str, list[np.dtype]]]
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], int]:
    """The values of each column with the length of each row's list (1 without a list), and the
    end of the element.
    """
    at, rows = start, []
    try:
        if (
            not 0
            <= count * max(sum(types[0].itemsize for _, types in columns), 1)
            <= len(body) - at
        ):
            raise EOFError
        if count:
            lengths, _, end = _ply_row(body, at, columns)
            end = start + (end - start) * count
            if end <= len(body):  # are all rows as long as the first?
                table = np.frombuffer(body, _ply_layout(columns, lengths), count, start)
                if all((table[k] == table[k][0]).all() for k in table.dtype.names if k[0] == "n"):
                    return {
                        column: (table[f"v{k}"].ravel(), np.full(count, length))
                        for k, ((column, _), length) in enumerate(
                            zip(columns, lengths, strict=True)
                        )
                    }, end
        for _ in range(count):
            rows.append(_ply_row(body, at, columns))
            at = rows[-1][2]
    except EOFError:
        raise EOFError(f"it ends within its {count} elements `{name}`") from None
    return {
        column: (
            np.frombuffer(b"".join(parts[k] for _, parts, _ in rows), types[-1]),
            np.array([lengths[k] for lengths, _, _ in rows], np.int64),
        )
        for k, (column, types) in enumerate(columns)
    }, at


def _ply_row(
    body: bytes, at: int, columns: list[tuple[str, list[np.dtype]]]
) -> tuple[list[int], list[bytes], int]:
    """The length and the bytes of each column of the row at `at`, and its end. Raises EOFError if
    the file ends before.
    """
    lengths, parts = [], []
    for _, types in columns:
        length = 1
        if len(types) > 1:
            if at + types[0].itemsize > len(body):
                raise EOFError
            length = int(np.frombuffer(body, types[0], 1, at)[0])
            at += types[0].itemsize
        if length < 0:
            raise ValueError("a list has a negative length")
        lengths.append(length)
        parts.append(body[at : at + length * types[-1].itemsize])
        at += length * types[-1].itemsize
    if at > len(body):
        raise EOFError
    return lengths, parts, at


def _ply_layout(columns: list[tuple[str, list[np.dtype]]], lengths: list[int]) -> np.dtype:
    """The type of rows whose lists have these lengths: n0, n1 ... are the lengths, v0, v1 ... the
    values.
    """
    fields = []
    for k, ((_, types), length) in enumerate(zip(columns, lengths, strict=True)):
        fields += [(f"n{k}", kind) for kind in types[:-1]] + [(f"v{k}", types[-1], (length,))]
    return np.dtype(fields)


def _cut(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> Triangles:
    if sizes.sum() != len(corners) or (len(sizes) and sizes.min() < 0):
        raise ValueError("a face has fewer corners than it says")
    return vertices, corners[triangulate(vertices, corners, sizes)]
