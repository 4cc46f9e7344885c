"""Tiny Debian packages made on the spot: meshes of boxes as text, catalogues, .deb files."""

from __future__ import annotations

import io
import subprocess
import tempfile
import zipfile
from pathlib import Path

import numpy as np

CATALOGUE = "PluginFurnitureCatalog.properties"
AIRCRAFT = "usr/share/games/flightgear/AI/Aircraft"


def box(low: tuple, high: tuple) -> tuple[np.ndarray, list[list[int]]]:
    corners = np.array(
        [
            [x, y, z]
            for x in (low[0], high[0])
            for y in (low[1], high[1])
            for z in (low[2], high[2])
        ],
        float,
    )
    return corners, [
        [0, 1, 3, 2],
        [4, 6, 7, 5],
        [0, 4, 5, 1],
        [2, 3, 7, 6],
        [0, 2, 6, 4],
        [1, 5, 7, 3],
    ]


def obj_text(*boxes: tuple[tuple, tuple]) -> str:
    lines = []
    for number, (low, high) in enumerate(boxes):
        corners, quads = box(low, high)
        lines += [f"v {x} {y} {z}" for x, y, z in corners]
        lines += ["f " + " ".join(f"{8 * number + i + 1}/1/1" for i in quad) for quad in quads]
    return "\n".join(lines)


def ac_object(name: str, low: tuple, high: tuple, kids: str = "kids 0") -> str:
    corners, quads = box(low, high)
    lines = ["OBJECT poly", f'name "{name}"', f"numvert {len(corners)}"]
    lines += [f"{x} {y} {z}" for x, y, z in corners]
    lines.append(f"numsurf {len(quads)}")
    for quad in quads:
        lines += ["SURF 0X30", "mat 0", "refs 4", *(f"{i} 0 0" for i in quad)]
    return "\n".join([*lines, kids])


def ac_text(*objects: str) -> str:
    return "\n".join(["AC3Db", "OBJECT world", f"kids {len(objects)}", *objects])


# An airplane of boxes in FlightGear's frame: nose -x, y up, left wing +z; fin at the tail, left tip lower.
AIRPLANE = (
    ac_object("fuselage", (-5, 0, -0.5), (5, 1, 0.5)),
    ac_object("wing-left", (-1, 0, 0.5), (1, 0.2, 4)),
    ac_object("wing-right", (-1, 0, -4), (1, 0.2, -0.5)),
    ac_object("tip", (-0.5, -1, 3.5), (0.5, 0, 4)),
    ac_object("fin", (4, 1, -0.1), (5, 3, 0.1)),
)
CHAIR = obj_text(
    ((0, 4, 0), (4, 5, 4)),
    ((0, 5, 0), (4, 10, 0.5)),
    ((0, 0, 0), (4, 4, 0.5)),
    ((0, 0, 3.5), (4, 4, 4)),
)
TABLE = obj_text(((0, 4, 0), (8, 5, 5)), ((3, 0, 2), (5, 4, 3)))


def deb(folder: Path, name: str, files: dict[str, bytes]) -> Path:
    """A Debian package of these files in the folder."""
    with tempfile.TemporaryDirectory() as root:
        about = {
            "Package": name,
            "Version": "1:2.0-1",
            "Architecture": "all",
            "Maintainer": "x",
            "Description": "x",
        }
        control = "".join(f"{key}: {value}\n" for key, value in about.items())
        for path, content in {"DEBIAN/control": control.encode(), **files}.items():
            (Path(root) / path).parent.mkdir(parents=True, exist_ok=True)
            (Path(root) / path).write_bytes(content)
        folder.mkdir(exist_ok=True)
        file = folder / f"{name}_1%3a2.0-1_all.deb"
        subprocess.run(
            ["dpkg-deb", "--build", "-Znone", root, file], check=True, capture_output=True
        )
    return file


def catalogue(entries: list[dict], models: dict[str, str]) -> bytes:
    lines = ["id=Test#Models", "license=Free Art License 1.3"]
    for number, entry in enumerate(entries, 1):
        lines += [f"{key}#{number}={value}" for key, value in entry.items()]
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr(CATALOGUE, "\n".join(lines))
        for path, text in models.items():
            archive.writestr(path, text)
    return data.getvalue()


def entry(name: str, stem: str, **more: str) -> dict:
    return {
        "name": name,
        "category": "Living room",
        "model": f"/m/{stem}.obj",
        "creator": "A. Maker",
        **more,
    }
