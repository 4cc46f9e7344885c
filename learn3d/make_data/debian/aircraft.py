"""Airplanes from the AI aircraft (.ac files) of Debian's flightgear-data-ai."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import PurePosixPath

import numpy as np
import trimesh

from learn3d.make_data.debian.packages import Candidate, Part, read_ac3d

AIRCRAFT_PACKAGE = "flightgear-data-ai"
FOLDER = "usr/share/games/flightgear/AI/Aircraft/"

NOT_AIRPLANES = re.compile(r"balloon|ferry|ship|heli|vehicle|truck|bluebird|shuttle|flash2a", re.IGNORECASE)
# Names of folders and stems of files that hold a part of an aircraft.
PART_FOLDERS = re.compile(r"^(lights?|refuel\w*)$", re.IGNORECASE)
PART_STEMS = re.compile(
    r"light(?!ning)|flare|^flash$|beacon|strobe|toggle|^nav[lr]?$|navback|taxi$|wheel|tank|probe|refuel|exhaust|banner|pilot|"
    r"engine|gear|ssme|oms",
    re.IGNORECASE,
)
# Names of objects in a file that draw motion, light or smoke, or the pilot; they are skipped.
EFFECTS = re.compile(
    r"prop.*dis[ck]|prplr-disk|disque.?helice|giro.?helice|(?<!ou)blur|prop.*(fast|slow)|(fast|slow)prop|"
    r"halo|glow|flare|^flash\d*$|recog$|flame|burner|cond?ens|chute$|light-?cone|banner|noshadow|"
    r"^pilot($|[-_])|helmet",
    re.IGNORECASE,
)
MIN_DISC = 0.09  # diameter of a propeller disc over the longest side of the airplane
DETACHED = 2e-3  # distance, over the longest side, at which a quadrilateral is not joined to other parts


def is_airplane_file(path: str) -> bool:
    """Whether an .ac path below AI/Aircraft names a whole airplane, not a part, a balloon or a ship."""
    folders, stem = PurePosixPath(path).parts[:-1], PurePosixPath(path).stem
    if any(NOT_AIRPLANES.search(name) for name in (*folders, stem)):
        return False
    return not any(PART_FOLDERS.match(name) for name in folders) and not PART_STEMS.search(stem)


def remove_effects(parts: list[Part]) -> list[Part]:
    """The parts without propeller discs and detached quadrilaterals: textures on them draw motion, light or vapour.

    A disc, or the square with its texture, is a part with a round or square outline that is wider than MIN_DISC. Its
    depth along the flight direction x is below 3 % of its diameter. A detached quadrilateral is a part of one or two
    triangles farther than DETACHED from all others, except from its own reverse side.
    """
    corners = [part.vertices[np.unique(part.faces)] for part in parts]
    size = np.ptp(np.concatenate(corners), axis=0).max()

    def is_disc(index: int) -> bool:
        x, y, z = np.ptp(corners[index], axis=0)
        triangles = parts[index].vertices[parts[index].faces]
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
        flat = x < 0.03 * max(y, z) and min(y, z) > 0.8 * max(y, z) and area.sum() / 2 > 0.55 * y * z
        return flat and max(y, z) > MIN_DISC * size

    def is_alone(index: int) -> bool:
        middle = corners[index].mean(axis=0)
        others = [points for points in corners if np.abs(points.mean(axis=0) - middle).max() > DETACHED * size]
        gaps = [np.linalg.norm(points[:, None] - corners[index], axis=2).min() for points in others]
        return bool(gaps) and min(gaps) > DETACHED * size

    return [p for k, p in enumerate(parts) if not is_disc(k) and not (len(p.faces) <= 2 and is_alone(k))]


def aircraft_models(files: Mapping[str, bytes]) -> Iterator[Candidate]:
    """The airplanes among the files of the package, by path."""
    texts = {p.removeprefix(FOLDER): text.decode("latin-1") for p, text in files.items() if p.startswith(FOLDER)}
    authors: dict[tuple[str, str], str] = {}  # (folder, name of a model file in it) -> author
    for path, text in texts.items():
        if path.endswith(".xml") and (author := re.search(r"<author>([^<]+)</author>", text)):
            name = " ".join(author[1].split())
            for model in re.findall(r"<path>([^<]+)</path>", text):
                key = path.split("/", 1)[0], PurePosixPath(model.strip()).name
                authors[key] = min(authors.get(key, name), name)
    for path in sorted(path for path in texts if path.endswith(".ac") and is_airplane_file(path)):
        folder, stem = path.split("/", 1)[0], PurePosixPath(path).stem
        yield Candidate(
            category="airplane",
            title=f"{folder} {stem}",
            author=authors.get((folder, PurePosixPath(path).name), "the FlightGear team"),
            licence="GPL-2+",
            source=FOLDER + path,
            stem=stem if folder.lower() in stem.lower() else f"{folder}-{stem}",
            read=partial(_read_aircraft, texts[path]),
        )


def _read_aircraft(text: str) -> Part:
    parts = remove_effects(read_ac3d(text, skip=EFFECTS.search))
    vertices, faces = trimesh.util.append_faces(*zip(*parts, strict=True))
    # from FlightGear's frame (nose -x, y up, left wing +z) to front +z, y up, left +x
    return Part(np.stack([vertices[:, 2], vertices[:, 1], -vertices[:, 0]], axis=1), faces)
