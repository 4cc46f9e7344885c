"""Models in Debian's packages: Sweet Home 3D's furniture, FlightGear's airplanes.

A catalogue (.sh3f) is a zip archive with a properties file (name#N, model#N, modelRotation#N,
...) and one OBJ per model. AI aircraft are AC3D files (.ac) with XML files beside them.
"""

import io
import re
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import PurePosixPath

import numpy as np
import trimesh
from ac3d import read_ac3d
from scipy.spatial.distance import cdist

from learn3d.files.formats import RawMesh
from nmr.obj import read_obj

#: Facts about a model of a package, which are columns of index.csv, with `stem`, the file name to
#: use without suffix; and a function that reads it (y up, front +z), or raises ValueError.
PackagedModel = tuple[dict[str, str], Callable[[], RawMesh]]

# The first pattern found in an entry's English name, in lower case, gives its category; None
# skips the entry.
FURNITURE_RULES: tuple[tuple[str, str | None], ...] = (
    (
        r"\b(switch|racket|bat|fan|freezer|wheelchair|ottoman|swinging|opened|skylight|tablet|flashlight)\b",
        None,
    ),
    (
        r"\b(knife|towel|clothes|hat|cd|wine|speech) .*\b(stand|rack|unit)\b|washbasin|changing table|extension",
        None,
    ),
    (r"candle|artwork", None),
    (r"\b(lamp|lantern|chandelier|lamppost|(light|lights|spotlight|strip)$)", "lamp"),
    (r"\b(sofa|couch|settee)\b", "sofa"),
    (r"\b(chair|armchair|stool|class seat)\b", "chair"),
    (r"\b(bedside table|night ?stand|tv stand)\b", "cabinet"),
    (r"\b(table|desk|workbench)\b", "table"),
    (r"\b(corner |cube )?shelf( (cherry|maple))?$", None),  # a board on the wall
    (
        r"\b(cabinet|cupboard|wardrobe|bookcase|dresser|sideboard|locker|commode|chest|closet)\b",
        "cabinet",
    ),
    (r"\b(drawers?|shelves|bookshelves|shelving|shelf|rack)\b", "cabinet"),
)
# Models with misleading names: two bedside ends of beds, a bathroom with its basin, two boards on
# a wall.
SKIPPED_MODELS = ("comodinoSinistro", "comodinoSinistroCiliegio", "bathroomFurniture", "shelving")
SKIPPED_SECTIONS = ("Characters", "Doors and windows", "Staircases", "Vehicles")


def furniture_category(name: str, section: str = "") -> str | None:
    """Category of a catalogue entry from its English name and its section; None to skip it."""
    if section in SKIPPED_SECTIONS:
        return None
    return next(
        (category for pattern, category in FURNITURE_RULES if re.search(pattern, name.lower())),
        None,
    )


def read_catalogue(text: str) -> tuple[dict[str, str], list[dict[str, str]]]:
    """General properties and entries (`key#N`, in the order of N) of a furniture catalogue."""
    # N -> entry; general properties under 0
    entries: defaultdict[int, dict[str, str]] = defaultdict(dict)
    for key, number, value in re.findall(
        r"^\s*(\w+)(?:#(\d+))?\s*=[^\S\n]*(.*)$", text, re.MULTILINE
    ):
        value = re.sub(r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), value).strip()
        entries[int(number or 0)][key] = value
    general = entries.pop(0, {})
    return general, [entries[number] for number in sorted(entries)]


def place_furniture(vertices: np.ndarray, entry: Mapping[str, str]) -> np.ndarray:
    """Vertices [V, 3] turned by modelRotation (nine numbers, p' = R p) and stretched to the box.

    The box is width x height x depth along x, y, z, as Sweet Home 3D draws it: y up, the front
    towards +z.
    """
    if "modelRotation" in entry:
        vertices = (
            vertices @ np.array(entry["modelRotation"].split(), dtype=np.float64).reshape(3, 3).T
        )
    if all(key in entry for key in ("width", "height", "depth")):
        extents = np.ptp(vertices, axis=0)
        if (extents > 0).all():
            vertices = vertices * (
                [float(entry[key]) for key in ("width", "height", "depth")] / extents
            )
    return vertices


def furniture_models(files: Mapping[str, bytes]) -> Iterator[PackagedModel]:
    """The pieces of furniture of every catalogue of a package, by catalogue and entry number."""
    for path in sorted(path for path in files if path.endswith(".sh3f")):
        archive, catalogue = zipfile.ZipFile(io.BytesIO(files[path])), PurePosixPath(path)
        general, entries = read_catalogue(
            archive.read("PluginFurnitureCatalog.properties").decode("latin-1")
        )
        for entry in entries:
            model = PurePosixPath(entry.get("model", "").removeprefix("/"))
            category = furniture_category(entry.get("name", ""), entry.get("category", ""))
            if category is not None and model.stem not in SKIPPED_MODELS:
                facts = {
                    "category": category,
                    "title": entry["name"],
                    "author": entry.get("creator", ""),
                    "licence": " ".join(
                        entry.get("license", general.get("license", "see the package")).split()
                    ),
                    "source": f"{catalogue.name}!/{model}",
                    "stem": f"{catalogue.stem}-{model.stem}",
                }
                yield facts, partial(_read_furniture, archive, str(model), entry)


def _read_furniture(archive: zipfile.ZipFile, model: str, entry: Mapping[str, str]) -> RawMesh:
    if not model.lower().endswith(".obj") or model not in archive.namelist():
        raise ValueError("the catalogue has no OBJ file of it")
    mesh = read_obj(io.BytesIO(archive.read(model)), with_uv=False)
    return RawMesh(place_furniture(mesh.vertices, entry), mesh.faces)


AIRCRAFT = "usr/share/games/flightgear/AI/Aircraft/"
# Paths below AI/Aircraft that are no airplanes, or only a part of one.
NOT_AIRPLANES = re.compile(
    r"balloon|ferry|ship|heli|vehicle|truck|bluebird|shuttle|flash2a|(^|/)(lights?|refuel\w*)/|"
    r"(light(?!ning)|flare|/flash\.|beacon|strobe|toggle|/nav[lr]?\.|navback|taxi\.|wheel|tank|probe|refuel|exhaust|"
    r"banner|pilot|engine|gear|ssme|oms)[^/]*$",
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
# distance, over the longest side, at which a quadrilateral is not joined to other parts
DETACHED = 2e-3


def remove_effects(parts: list[RawMesh]) -> list[RawMesh]:
    """Leave out propeller discs and detached quadrilaterals: pictures of motion, light or vapour.

    A disc, or the square with its texture, is a part with a round or square outline that is wider
    than MIN_DISC. Its depth along the flight direction x is below 3 % of its diameter. A detached
    quadrilateral is a part of one or two triangles farther than DETACHED from all others, except
    from its own reverse side.
    """
    corners = [part.vertices[np.unique(part.faces)] for part in parts]
    size = np.ptp(np.concatenate(corners), axis=0).max()

    def is_disc(part: RawMesh, own: np.ndarray) -> bool:
        x, y, z = np.ptp(own, axis=0)
        area = trimesh.triangles.area(part.vertices[part.faces]).sum()
        return (
            max(y, z) > max(MIN_DISC * size, x / 0.03)
            and min(y, z) > 0.8 * max(y, z)
            and area > 0.55 * y * z
        )

    def is_alone(own: np.ndarray) -> bool:
        middle = own.mean(axis=0)
        others = [
            points
            for points in corners
            if np.abs(points.mean(axis=0) - middle).max() > DETACHED * size
        ]
        return min((cdist(points, own).min() for points in others), default=0) > DETACHED * size

    found = zip(parts, corners, strict=True)
    return [
        part
        for part, own in found
        if not is_disc(part, own) and not (len(part.faces) <= 2 and is_alone(own))
    ]


def aircraft_models(files: Mapping[str, bytes]) -> Iterator[PackagedModel]:
    """The airplanes among the files of the package, by path."""
    texts = {
        p.removeprefix(AIRCRAFT): text.decode("latin-1")
        for p, text in files.items()
        if p.startswith(AIRCRAFT)
    }
    authors: dict[tuple[str, str], str] = {}  # (folder, name of a model file in it) -> author
    for path, text in texts.items():
        if path.endswith(".xml") and (author := re.search(r"<author>([^<]+)</author>", text)):
            name = " ".join(author[1].split())
            for model in re.findall(r"<path>([^<]+)</path>", text):
                key = path.split("/", 1)[0], PurePosixPath(model.strip()).name
                authors[key] = min(authors.get(key, name), name)
    for path in sorted(
        path for path in texts if path.endswith(".ac") and not NOT_AIRPLANES.search(path)
    ):
        folder, stem = path.split("/", 1)[0], PurePosixPath(path).stem
        facts = {
            "category": "airplane",
            "title": f"{folder} {stem}",
            "author": authors.get((folder, PurePosixPath(path).name), "the FlightGear team"),
            "licence": "GPL-2+",
            "source": AIRCRAFT + path,
            "stem": stem if folder.lower() in stem.lower() else f"{folder}-{stem}",
        }
        yield facts, partial(_read_aircraft, texts[path])


def _read_aircraft(text: str) -> RawMesh:
    parts = remove_effects(read_ac3d(text, skip=EFFECTS.search))
    vertices, faces = trimesh.util.append_faces(
        [part.vertices for part in parts], [part.faces for part in parts]
    )
    # from FlightGear's frame (nose -x, y up, left wing +z) to front +z, y up, left +x
    return RawMesh(np.stack([vertices[:, 2], vertices[:, 1], -vertices[:, 0]], axis=1), faces)


#: What is found in each package; the one from non-free is optional.
PACKAGES = {
    "sweethome3d-furniture": furniture_models,
    "sweethome3d-furniture-nonfree": furniture_models,
    "flightgear-data-ai": aircraft_models,
}
