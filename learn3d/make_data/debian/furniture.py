"""Chairs, tables, cabinets, sofas and lamps from the catalogues (.sh3f) of Debian's sweethome3d-furniture packages.

A catalogue is a zip archive with a properties file (name#N, model#N, modelRotation#N, ...) and one OBJ per model.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import PurePosixPath

import numpy as np

from learn3d.make_data.debian.packages import Candidate, Part, read_obj

FURNITURE_PACKAGES = ("sweethome3d-furniture", "sweethome3d-furniture-nonfree")  # the second is optional

# The first pattern found in an entry's English name, in lower case, gives its category; None skips the entry.
FURNITURE_RULES: tuple[tuple[str, str | None], ...] = (
    (r"\b(switch|racket|bat|fan|freezer|wheelchair|ottoman|swinging|opened|skylight|tablet|flashlight)\b", None),
    (r"\b(knife|towel|clothes|hat|cd|wine|speech) .*\b(stand|rack|unit)\b|washbasin|changing table|extension", None),
    (r"candle|artwork", None),
    (r"\b(lamp|lantern|chandelier|lamppost|(light|lights|spotlight|strip)$)", "lamp"),
    (r"\b(sofa|couch|settee)\b", "sofa"),
    (r"\b(chair|armchair|stool|class seat)\b", "chair"),
    (r"\b(bedside table|night ?stand|tv stand)\b", "cabinet"),
    (r"\b(table|desk|workbench)\b", "table"),
    (r"\b(corner |cube )?shelf( (cherry|maple))?$", None),  # a board on the wall
    (r"\b(cabinet|cupboard|wardrobe|bookcase|dresser|sideboard|locker|commode|chest|closet)\b", "cabinet"),
    (r"\b(drawers?|shelves|bookshelves|shelving|shelf|rack)\b", "cabinet"),
)
# Models with misleading names: two bedside ends of beds, a bathroom with its basin, two boards on a wall.
SKIPPED_MODELS = ("comodinoSinistro", "comodinoSinistroCiliegio", "bathroomFurniture", "shelving")
SKIPPED_SECTIONS = ("Characters", "Doors and windows", "Staircases", "Vehicles")


def furniture_category(name: str, section: str = "") -> str | None:
    """Category of a catalogue entry from its English name and its section; None if the entry is skipped."""
    if section in SKIPPED_SECTIONS:
        return None
    return next((category for pattern, category in FURNITURE_RULES if re.search(pattern, name.lower())), None)


def read_catalogue(text: str) -> tuple[dict[str, str], list[dict[str, str]]]:
    """The general properties and the entries (`key#N`, in the order of N) of a Sweet Home 3D furniture catalogue."""
    entries: defaultdict[int, dict[str, str]] = defaultdict(dict)  # N -> entry; general properties under 0
    for key, number, value in re.findall(r"^\s*(\w+)(?:#(\d+))?\s*=[^\S\n]*(.*)$", text, re.MULTILINE):
        value = re.sub(r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), value).strip()
        entries[int(number or 0)][key] = value
    general = entries.pop(0, {})
    return general, [entries[number] for number in sorted(entries)]


def place_furniture(vertices: np.ndarray, entry: Mapping[str, str]) -> np.ndarray:
    """Vertices [V, 3] turned by the entry's modelRotation (nine numbers by rows, p' = R p) and stretched to its box.

    The box is width x height x depth along x, y, z, as Sweet Home 3D draws it: y up, the front towards +z.
    """
    if "modelRotation" in entry:
        vertices = vertices @ np.array(entry["modelRotation"].split(), dtype=np.float64).reshape(3, 3).T
    if all(key in entry for key in ("width", "height", "depth")):
        extents = np.ptp(vertices, axis=0)
        if (extents > 0).all():
            vertices = vertices * ([float(entry[key]) for key in ("width", "height", "depth")] / extents)
    return vertices


def furniture_models(files: Mapping[str, bytes]) -> Iterator[Candidate]:
    """The pieces of furniture of every catalogue of a package, by catalogue and entry number."""
    for path, content in sorted(files.items()):
        catalogue = PurePosixPath(path).name
        if not catalogue.endswith(".sh3f"):
            continue
        archive = zipfile.ZipFile(io.BytesIO(content))
        general, entries = read_catalogue(archive.read("PluginFurnitureCatalog.properties").decode("latin-1"))
        for entry in entries:
            model = PurePosixPath(entry.get("model", "").removeprefix("/"))
            category = furniture_category(entry.get("name", ""), entry.get("category", ""))
            if category is not None and model.stem not in SKIPPED_MODELS:
                yield Candidate(
                    category=category,
                    title=entry["name"],
                    author=entry.get("creator", ""),
                    licence=" ".join(entry.get("license", general.get("license", "see the package")).split()),
                    source=f"{catalogue}!/{model}",
                    stem=f"{PurePosixPath(catalogue).stem}-{model.stem}",
                    read=partial(_read_furniture, archive, str(model), entry),
                )


def _read_furniture(archive: zipfile.ZipFile, model: str, entry: Mapping[str, str]) -> Part:
    if not model.lower().endswith(".obj"):
        raise ValueError("only OBJ models are read")
    if model not in archive.namelist():
        raise ValueError("the model is missing in its catalogue")
    vertices, faces = read_obj(archive.read(model).decode("latin-1"))
    return Part(place_furniture(vertices, entry), faces)
