"""Airplanes from the AI aircraft (.ac files) of Debian's flightgear-data-ai."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
import trimesh
from tqdm import tqdm

from learn3d.files import limits
from learn3d.make_data.debian.mesh_text import Part, read_ac3d
from learn3d.make_data.debian.packages import Candidate, Package, read_package

AIRCRAFT_PACKAGE = "flightgear-data-ai"
AIRCRAFT_FOLDER = "usr/share/games/flightgear/AI/Aircraft/"
AIRCRAFT_LICENCE = "GPL-2+"
AIRCRAFT_AUTHOR = "the FlightGear team"

NOT_AIRPLANES = re.compile(r"balloon|ferry|ship|heli|vehicle|truck|bluebird|shuttle|flash2a", re.IGNORECASE)
# Files that hold a part of an aircraft: by their folder or their stem.
PART_FOLDERS = re.compile(r"^(lights?|refuel\w*)$", re.IGNORECASE)
PART_STEMS = re.compile(
    r"light(?!ning)|flare|^flash$|beacon|strobe|toggle|^nav[lr]?$|navback|taxi$|wheel|tank|probe|refuel|exhaust|banner|pilot|"
    r"engine|gear|ssme|oms",
    re.IGNORECASE,
)
# Objects inside a file that stand for motion, light or smoke, or for the pilot: left out by name.
EFFECTS = re.compile(
    r"prop.*dis[ck]|prplr-disk|disque.?helice|giro.?helice|(?<!ou)blur|prop.*(fast|slow)|(fast|slow)prop|"
    r"halo|glow|flare|^flash\d*$|recog$|flame|burner|cond?ens|chute$|light-?cone|banner|noshadow|"
    r"^pilot($|[-_])|helmet",
    re.IGNORECASE,
)
_PATH = re.compile(r"<path>([^<]+)</path>")
DISC_DIAMETER = 0.09  # of the longest side: a flat disc across the flight direction that wide is a propeller disc
DETACHED = 2e-3  # of the longest side: a lone quadrilateral that far from every other vertex is drawn light or vapour


def is_airplane_file(path: str) -> bool:
    """Whether an .ac path below AI/Aircraft names a whole airplane, not a part, a balloon or a ship."""
    folders, stem = PurePosixPath(path).parts[:-1], PurePosixPath(path).stem
    if any(NOT_AIRPLANES.search(name) for name in (*folders, stem)):
        return False
    return not any(PART_FOLDERS.match(name) for name in folders) and not PART_STEMS.search(stem)


def turn_to_front(vertices: np.ndarray) -> np.ndarray:
    """FlightGear's AC3D frame (nose -x, y up, left wing +z) to the frame of the furniture: front +z, y up, left +x."""
    return np.stack([vertices[:, 2], vertices[:, 1], -vertices[:, 0]], axis=1)


def without_effects(parts: list[Part]) -> list[Part]:
    """The parts less propeller discs and lone quadrilaterals, which draw motion, light or vapour by their texture.

    A disc (or the square it is drawn on) is a part whose depth along the flight direction x is under 3 % of its
    diameter, of round or square outline, and wider than DISC_DIAMETER of the whole. A lone quadrilateral is a part of
    one or two triangles that no other part comes near (DETACHED), except its own other side at the same place.
    """
    corners = [part.vertices[np.unique(part.faces)] for part in parts]
    size = np.ptp(np.concatenate(corners), axis=0).max()
    kept = []
    for index, part in enumerate(parts):
        x, y, z = np.ptp(corners[index], axis=0)
        a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        flat = x < 0.03 * max(y, z) and min(y, z) > 0.8 * max(y, z) and area > 0.55 * y * z
        if flat and max(y, z) > DISC_DIAMETER * size:
            continue
        if len(part.faces) <= 2 and len(parts) > 1:
            middle = corners[index].mean(axis=0)  # its other side, at the same place, does not count
            others = [points for points in corners if np.abs(points.mean(axis=0) - middle).max() > DETACHED * size]
            gaps = [np.linalg.norm(points[:, None] - corners[index], axis=2).min() for points in others]
            if gaps and min(gaps) > DETACHED * size:
                continue
        kept.append(part)
    return kept


def aircraft_models(package: Package, licences: Path, progress: bool) -> Iterator[Candidate | None]:
    """Airplanes of the package by path; None for a file that is no airplane. The copyright file goes to `licences`."""
    texts: dict[str, str] = {}
    authors: dict[tuple[str, str], str] = {}  # of a folder and the name of a model in it
    files = read_package(package, (".ac", ".xml"), licences)
    for path, content in tqdm(files, desc=f"reading {package.name}", unit="file", disable=not progress, leave=False):
        if not path.startswith(AIRCRAFT_FOLDER):
            continue
        below, text = path.removeprefix(AIRCRAFT_FOLDER), content.decode("latin-1")
        if path.endswith(".ac"):
            texts[below] = text
        elif author := re.search(r"<author>([^<]+)</author>", text):
            name = " ".join(author[1].split())
            for model in map(str.strip, _PATH.findall(text)):
                key = below.split("/", 1)[0], PurePosixPath(model).name
                authors[key] = min(authors.get(key, name), name)
    for path in tqdm(sorted(texts), desc=package.name, unit="model", disable=not progress, leave=False):
        folder, stem = path.split("/", 1)[0], PurePosixPath(path).stem
        if not is_airplane_file(path):
            yield None
            continue
        yield Candidate(
            category="airplane",
            title=f"{folder} {stem}",
            author=authors.get((folder, PurePosixPath(path).name), AIRCRAFT_AUTHOR),
            licence=AIRCRAFT_LICENCE,
            package=package,
            source=AIRCRAFT_FOLDER + path,
            stem=stem if folder.lower() in stem.lower() else f"{folder}-{stem}",
            read=partial(_read_aircraft, texts[path]),
        )


def _read_aircraft(text: str) -> tuple[np.ndarray, np.ndarray]:
    parts = read_ac3d(text, skip=lambda name: EFFECTS.search(name[: limits.NAME_LENGTH]) is not None)
    if not parts or not (parts := without_effects(parts)):
        raise ValueError("no polygon is left")
    vertices, faces = trimesh.util.append_faces([p.vertices for p in parts], [p.faces for p in parts])
    return turn_to_front(vertices), faces
