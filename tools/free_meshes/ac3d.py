"""Reads AC3D, the format of FlightGear's models, which trimesh does not read.

Positions and triangles only.
"""

from collections.abc import Callable, Iterator

import numpy as np

from learn3d.files.formats import RawMesh
from nmr.obj import triangulate


def read_ac3d(text: str, skip: Callable[[str], object]) -> list[RawMesh]:
    """Objects of an AC3D text with polygons, placed by the `loc` and `rot` of their ancestors.

    Skips lines (surface types 1 and 2), and objects with a name that `skip` accepts, with their
    children. Frame of FlightGear's models: nose towards -x, y up, left wing towards +z. Raises
    ValueError if the text is not AC3D or incomplete.
    """
    # some exporters add blank lines
    lines = (line for line in map(str.strip, text.splitlines()) if line)
    if not next(lines, "").startswith("AC3D"):
        raise ValueError("not an AC3D file: it does not start with AC3D")
    try:
        return list(_read_objects(lines, 1, np.eye(3), np.zeros(3), skip))
    except (
        RuntimeError,
        LookupError,
    ) as error:  # a generator turns StopIteration into a RuntimeError
        raise ValueError("the AC3D file ends in the middle of an object") from error


def _read_objects(
    lines: Iterator[str],
    count: int,
    rotation: np.ndarray,
    translation: np.ndarray,
    skip: Callable[[str], object],
) -> Iterator[RawMesh]:
    """The next `count` objects with their children.

    The parent's frame is v @ rotation [3, 3] + translation [3].
    """
    for _ in range(count):
        if not any(line.startswith("OBJECT") for line in lines):
            return
        fields = {"name": "", "rot": "1 0 0 0 1 0 0 0 1", "loc": "0 0 0"}
        rows = []
        polygons = []
        key = ""
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
                vertices = np.array(rows, np.float64).reshape(-1, 3) @ turn + shift
                corners = np.concatenate(polygons)
                yield RawMesh(
                    vertices,
                    corners[triangulate(vertices, corners, np.array([*map(len, polygons)]))],
                )
            yield from children
