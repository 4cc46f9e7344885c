"""Chairs, tables, cabinets, sofas and lamps from the catalogues (.sh3f) of Debian's sweethome3d-furniture packages.

A catalogue is a zip archive with a properties file (name#N, model#N, modelRotation#N, ...) and one OBJ per model.
"""

from __future__ import annotations

import io
import re
import zipfile
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from tqdm import tqdm

from learn3d.files import limits
from learn3d.make_data.debian.mesh_text import read_obj
from learn3d.make_data.debian.packages import Candidate, Package, read_package

FURNITURE_PACKAGES = ("sweethome3d-furniture", "sweethome3d-furniture-nonfree")  # the second is optional
CATALOGUE = "PluginFurnitureCatalog.properties"

# The first rule whose words occur in the English name of the catalogue gives the category; None leaves the piece out.
# Each pattern is searched in "name" as written in the catalogue, lower case.
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
# Models that do not look like their names: two beds' bedside ends, a bathroom with its basin, two boards on a wall.
MISFITS = ("comodinoSinistro", "comodinoSinistroCiliegio", "bathroomFurniture", "shelving")
FURNITURE_SECTIONS_LEFT_OUT = ("Characters", "Doors and windows", "Staircases", "Vehicles")


def furniture_category(name: str, section: str = "") -> str | None:
    """Category of a catalogue entry from its English name and the section it is listed in; None if it has none.

    Names of over 200 characters have none: some patterns take the square of the length.
    """
    if section in FURNITURE_SECTIONS_LEFT_OUT or len(name) > limits.NAME_LENGTH:
        return None
    for pattern, category in FURNITURE_RULES:
        if re.search(pattern, name.lower()):
            return category
    return None


def read_catalogue(text: str) -> tuple[dict[str, str], list[dict[str, str]]]:
    """The general properties and the entries (`key#N`, in the order of N) of a Sweet Home 3D furniture catalogue."""
    general: dict[str, str] = {}
    entries: dict[int, dict[str, str]] = {}
    for line in text.splitlines():
        match = re.match(r"\s*(\w+)(?:#(\d+))?\s*=\s*(.*)", line)
        if match:
            key, number, value = match.groups()
            if len(number or "") > 9:
                continue
            value = re.sub(r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), value).strip()
            value = value.encode("utf-8", "replace").decode()  # half of a pair of surrogates is no character
            (general if number is None else entries.setdefault(int(number), {}))[key] = value
    return general, [entries[number] for number in sorted(entries)]


def place_furniture(vertices: np.ndarray, entry: dict[str, str]) -> np.ndarray:
    """Vertices [V, 3] turned by the entry's modelRotation (nine numbers by rows, p' = R p) and stretched to its box.

    The box is width x height x depth along x, y, z, as Sweet Home 3D draws it: y up, the front towards +z.
    Raises ValueError for a modelRotation that is not a rotation.
    """
    if "modelRotation" in entry:
        numbers = np.array(entry["modelRotation"].split(), dtype=np.float64)
        rotation = numbers.reshape(3, 3) if numbers.size == 9 else np.zeros((3, 3))
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
            raise ValueError(f"modelRotation is not a rotation: {entry['modelRotation']}")
        vertices = vertices @ rotation.T
    if len(vertices) and all(key in entry for key in ("width", "height", "depth")):
        extents = np.ptp(vertices, axis=0)
        size = np.array([float(entry[key]) for key in ("width", "height", "depth")])
        if (extents > 0).all() and (size > 0).all():
            vertices = vertices * (size / extents)
    return vertices


def furniture_models(
    package: Package, categories: tuple[str, ...], licences: Path, progress: bool
) -> Iterator[Candidate | None]:
    """Models of every catalogue of a package, by catalogue and entry number; None for an entry of no wanted category.

    The package's copyright file goes to the folder `licences`.
    Raises ValueError for a catalogue that is damaged.
    """
    for path, content in sorted(read_package(package, (".sh3f",), licences)):
        catalogue = PurePosixPath(path).name
        try:
            archive = zipfile.ZipFile(io.BytesIO(content))
        except (zipfile.BadZipFile, NotImplementedError, ValueError, EOFError, OSError) as error:
            raise ValueError(f"{catalogue} is refused as a zip archive: {error}; get its package again") from error
        with archive:
            general, entries = read_catalogue(_member(archive, CATALOGUE))
            for entry in tqdm(entries, desc=catalogue, unit="model", disable=not progress, leave=False):
                model = PurePosixPath(entry.get("model", "").removeprefix("/"))
                category = furniture_category(entry.get("name", ""), entry.get("category", ""))
                if category not in categories or model.stem in MISFITS:
                    yield None
                    continue
                try:
                    text = _member(archive, str(model))
                except ValueError as error:
                    text = error  # is raised when the model is read: other models go on
                yield Candidate(
                    category=category,
                    title=entry["name"],
                    author=entry.get("creator", ""),
                    licence=" ".join(entry.get("license", general.get("license", "see the package")).split()),
                    package=package,
                    source=f"{catalogue}!/{model}",
                    stem=f"{PurePosixPath(catalogue).stem}-{model.stem}",
                    read=partial(_read_furniture, text, model.suffix, entry),
                )


def _read_furniture(text: str | ValueError, suffix: str, entry: dict[str, str]) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(text, ValueError):
        raise text
    if suffix.lower() != ".obj":
        raise ValueError(f"only OBJ models are read, this is {suffix or 'nothing'}")
    vertices, faces = read_obj(text)
    return place_furniture(vertices, entry), faces


def _member(archive: zipfile.ZipFile, path: str) -> str:
    """A text in a catalogue; ValueError if it is missing, damaged or over 64 MiB."""
    try:
        info = archive.getinfo(path)
        if info.file_size > limits.CATALOGUE_MEMBER_BYTES:
            raise ValueError(f"{info.file_size} bytes; at most {limits.CATALOGUE_MEMBER_BYTES} are read")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"compressed with method {info.compress_type}; only deflate is read")
        return archive.read(info).decode("latin-1")
    except (KeyError, ValueError, RuntimeError, NotImplementedError, zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise ValueError(f"{path} cannot be read from the catalogue ({error})") from error
