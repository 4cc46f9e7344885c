"""Real meshes from Debian packages: chairs, tables, cabinets, sofas, lamps (Sweet Home 3D) and airplanes (FlightGear).

`fetch_debian_models` writes OUTPUT/CATEGORY/NAME.ply, welded, y up, facing +z, box centred at the origin, longest side 1, with
OUTPUT/index.csv (what each mesh is and under which licence), OUTPUT/dropped.csv (what was left out and why) and the packages'
copyright files. The same packages give the same bytes.
"""

from __future__ import annotations

import csv
import os
import re
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path, PurePosixPath

import numpy as np
from tqdm import tqdm

from learn3d.data import debian_packages as packages
from learn3d.data.mesh_cleaning import clean_mesh, is_watertight, overlap, surface_grid
from learn3d.data.mesh_text import Part, read_ac3d, read_obj, write_ply

AIRCRAFT_PACKAGE = "flightgear-data-ai"
FURNITURE_PACKAGES = ("sweethome3d-furniture", "sweethome3d-furniture-nonfree")  # the second is optional
CATEGORIES = ("airplane", "chair", "table", "cabinet", "sofa", "lamp")
CATALOGUE = "PluginFurnitureCatalog.properties"
AIRCRAFT_FOLDER = "usr/share/games/flightgear/AI/Aircraft/"
AIRCRAFT_LICENCE = "GPL-2+"
AIRCRAFT_AUTHOR = "the FlightGear team"
GRID = 24  # cells per side when surfaces are compared


@dataclass(frozen=True)
class FetchConfig:
    """What to take from where."""

    output: Path  # folder to write
    categories: tuple[str, ...] = CATEGORIES  # which of the six categories
    packages_dir: Path | None = None  # folder with the .deb files; without it they are downloaded with apt-get
    root: Path | None = None  # take the packages as installed below this folder ("/" for this machine)
    overwrite: bool = False  # replace an earlier output
    duplicate_iou: float = 0.85  # two surfaces with a greater overlap are one model; 1 keeps everything
    progress: bool = True  # draw progress bars


@dataclass(frozen=True)
class Model:
    """One mesh that was written: a row of index.csv."""

    category: str
    file: str  # path below the output folder
    title: str  # the maker's name for it
    author: str
    licence: str
    package: str
    version: str
    source: str  # path inside the package; for furniture CATALOGUE.sh3f!/path
    vertices: int
    faces: int
    watertight: bool  # each edge belongs to exactly two faces


@dataclass(frozen=True)
class Dropped:
    """One model of a wanted category that was not written: a row of dropped.csv."""

    category: str
    title: str
    package: str
    source: str
    reason: str


@dataclass(frozen=True)
class Report:
    """What `fetch_debian_models` did."""

    output: Path
    models: tuple[Model, ...]
    dropped: tuple[Dropped, ...]
    ignored: int  # models of other categories
    notes: tuple[str, ...]  # optional packages that were not there

    def summary(self) -> str:
        """A few lines for a person: counts per category, reasons of what was dropped, notes."""
        kept = Counter(model.category for model in self.models)
        closed = Counter(model.category for model in self.models if model.watertight)
        lines = [f"{category:9s}{kept[category]:5d} meshes, {closed[category]} watertight" for category in kept]
        reasons = Counter(re.sub(r" \(.*| of .*", "", drop.reason) for drop in self.dropped)
        lines += [f"{count} dropped: {reason}" for reason, count in reasons.most_common()]
        return "\n".join([*lines, f"{self.ignored} models of other categories", *self.notes, f"written to {self.output}"])


@dataclass(frozen=True)
class Candidate:
    """A model of a wanted category before cleaning; `mesh` is (vertices, faces), or the reason why there is none."""

    category: str
    title: str
    author: str
    licence: str
    package: packages.Package
    source: str
    stem: str  # file name without suffix
    mesh: tuple[np.ndarray, np.ndarray] | str


# ---------------------------------------------------------------- furniture

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
FURNITURE_SECTIONS_LEFT_OUT = ("Characters", "Doors and windows", "Staircases", "Vehicles")


def furniture_category(name: str, section: str = "") -> str | None:
    """Category of a catalogue entry from its English name and the section it is listed in; None if it has none."""
    if section in FURNITURE_SECTIONS_LEFT_OUT:
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
            value = re.sub(r"\\u([0-9a-fA-F]{4})", lambda code: chr(int(code[1], 16)), value).strip()
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


def _furniture(package: packages.Package, config: FetchConfig) -> Iterable[Candidate | None]:
    """Candidates of every catalogue of a package; None for an entry of no category."""
    for path, content in packages.read_package(package, (".sh3f",)):
        catalogue = PurePosixPath(path).name
        with packages.open_catalogue(content, catalogue) as archive:
            general, entries = read_catalogue(packages.read_member(archive, CATALOGUE).decode("latin-1"))
            progress = tqdm(entries, desc=catalogue, unit="model", disable=not config.progress, leave=False)
            for entry in progress:
                category = furniture_category(entry.get("name", ""), entry.get("category", ""))
                if category not in config.categories:
                    yield None
                    continue
                model = entry.get("model", "").removeprefix("/")
                licence = " ".join(entry.get("license", general.get("license", "see the package")).split())
                yield Candidate(
                    category=category,
                    title=entry["name"],
                    author=entry.get("creator", ""),
                    licence=licence,
                    package=package,
                    source=f"{catalogue}!/{model}",
                    stem=f"{PurePosixPath(catalogue).stem}-{PurePosixPath(model).stem}",
                    mesh=_furniture_mesh(archive, model, entry),
                )


def _furniture_mesh(archive: zipfile.ZipFile, model: str, entry: dict) -> tuple[np.ndarray, np.ndarray] | str:
    if not model.lower().endswith(".obj"):
        return f"unreadable (only OBJ models are read, this is {PurePosixPath(model).suffix or 'nothing'})"
    try:
        vertices, faces = read_obj(packages.read_member(archive, model).decode("latin-1"))
        return place_furniture(vertices, entry), faces
    except ValueError as error:
        return f"unreadable ({error})"


# ---------------------------------------------------------------- aircraft

NOT_AIRPLANES = re.compile(r"balloon|ferry|ship|heli|vehicle|truck|bluebird", re.IGNORECASE)
# Files that hold a part of an aircraft: their folder or their stem.
PART_FOLDERS = re.compile(r"^(lights?|refuel\w*)$", re.IGNORECASE)
PART_STEMS = re.compile(
    r"light|flare|flash|beacon|strobe|^nav[lr]?$|navback|taxi$|wheel|tank|probe|refuel|exhaust|banner|pilot|engine|gear|ssme|oms",
    re.IGNORECASE,
)
# Objects inside a file that stand for motion, light or smoke, not for a solid: left out by name.
EFFECTS = re.compile(
    r"prop(eller)?[^a-z]*(\w+[^a-z])?(dis[ck]|blur|fast)|fast_?prop|prplr-disk|blur|disque|helice.?disque|halo|flare|flame|"
    r"burner|cond?ens|\bchute\b|^chute$|light-?cone|banner|shadow$|pilot(?!seat|-ext|-doub)|helmet",
    re.IGNORECASE,
)
DISC_DIAMETER = 0.09  # of the longest side: a flat disc across the flight direction that wide is a propeller disc


def is_airplane_file(path: str) -> bool:
    """Whether an .ac path below AI/Aircraft names a whole airplane, not a part, a balloon or a ship."""
    folders, stem = PurePosixPath(path).parts[:-1], PurePosixPath(path).stem
    if any(NOT_AIRPLANES.search(name) for name in (*folders, stem)):
        return False
    return not any(PART_FOLDERS.match(name) for name in folders) and not PART_STEMS.search(stem)


def turn_to_front(vertices: np.ndarray) -> np.ndarray:
    """FlightGear's AC3D frame (nose -x, y up, left wing +z) to the frame of the furniture: front +z, y up, left +x."""
    return np.stack([vertices[:, 2], vertices[:, 1], -vertices[:, 0]], axis=1)


def without_discs(parts: list[Part]) -> list[Part]:
    """The parts less the flat discs (or discs drawn on squares) across the flight direction x: turning propellers.

    A part goes when its depth along x is under 3 % of its diameter, its outline is about round or square and wider than
    DISC_DIAMETER of the whole.
    """
    everything = np.concatenate([part.vertices for part in parts])
    whole = np.ptp(everything, axis=0).max()
    kept = []
    for part in parts:
        x, y, z = np.ptp(part.vertices[np.unique(part.faces)], axis=0)
        a, b, c = (part.vertices[part.faces[:, i]] for i in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        flat = x < 0.03 * max(y, z) and min(y, z) > 0.8 * max(y, z) and area > 0.55 * y * z
        if not (flat and max(y, z) > DISC_DIAMETER * whole):
            kept.append(part)
    return kept


def _aircraft(package: packages.Package, config: FetchConfig) -> Iterable[Candidate | None]:
    """Candidates of the aircraft package in the order of their paths; None for a file that is no airplane."""
    models: dict[str, tuple[np.ndarray, np.ndarray] | str] = {}
    authors: dict[tuple[str, str], str] = {}
    files = packages.read_package(package, (".ac", ".xml"))
    for path, content in tqdm(files, desc=package.name, unit="file", disable=not config.progress, leave=False):
        if not path.startswith(AIRCRAFT_FOLDER):
            continue
        below = path.removeprefix(AIRCRAFT_FOLDER)
        folder = below.split("/", 1)[0]
        text = content.decode("latin-1")
        if path.endswith(".xml"):
            author = re.search(r"<author>([^<]+)</author>", text)
            for model in re.findall(r"<path>\s*([^<]+\.ac)\s*</path>", text) if author else ():
                key = (folder, PurePosixPath(model).name)
                authors[key] = min(authors.get(key, author[1].strip()), author[1].strip())
        elif not is_airplane_file(below):
            yield None
        else:
            models[path] = _aircraft_mesh(text)
    for path in sorted(models):
        folder, stem = path.removeprefix(AIRCRAFT_FOLDER).split("/", 1)[0], PurePosixPath(path).stem
        yield Candidate(
            category="airplane",
            title=f"{folder} {stem}",
            author=authors.get((folder, PurePosixPath(path).name), AIRCRAFT_AUTHOR),
            licence=AIRCRAFT_LICENCE,
            package=package,
            source=path,
            stem=stem if folder.lower() in stem.lower() else f"{folder}-{stem}",
            mesh=models[path],
        )


def _aircraft_mesh(text: str) -> tuple[np.ndarray, np.ndarray] | str:
    try:
        parts = read_ac3d(text, skip=lambda name: EFFECTS.search(name) is not None)
    except ValueError as error:
        return f"unreadable ({error})"
    parts = without_discs(parts) if parts else []
    if not parts:
        return "empty (no polygon is left)"
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    return turn_to_front(vertices), faces


# ---------------------------------------------------------------- all together


def fetch_debian_models(config: FetchConfig) -> Report:
    """Write the meshes that `config` names into its output folder; the folder appears at once or not at all.

    Raises ValueError (a sentence that says what to do) for unknown categories, an output that is there already, a package
    that cannot be had, and archives that are damaged or unsafe. A single unreadable model is reported, not raised.
    """
    unknown = [name for name in config.categories if name not in CATEGORIES]
    if unknown or not config.categories:
        raise ValueError(f"categories must be some of {', '.join(CATEGORIES)}; got {', '.join(unknown) or 'none'}")
    if config.packages_dir is not None and config.root is not None:
        raise ValueError("give either --packages-dir or --root, not both")
    if not 0 < config.duplicate_iou <= 1:
        raise ValueError(f"duplicate_iou must be in (0, 1], got {config.duplicate_iou}")
    output = config.output.resolve()
    if output.exists():
        if not config.overwrite:
            raise ValueError(f"{config.output} is there already; remove it, or replace it with --overwrite")
        if not (output / "index.csv").is_file():
            raise ValueError(f"{config.output} was not written by this tool (no index.csv); choose another folder")
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as scratch:
        written, downloads = Path(scratch, "models"), Path(scratch, "packages")
        written.mkdir()
        downloads.mkdir()
        report = _write_all(config, written, downloads)
        if output.exists():
            os.replace(output, Path(scratch, "old"))
        os.replace(written, output)
    return report


def _write_all(config: FetchConfig, folder: Path, downloads: Path) -> Report:
    """The body of `fetch_debian_models`: models, tables and copyright files into `folder`."""
    sources = []
    notes = []
    if set(config.categories) - {"airplane"}:
        sources += [(name, _furniture) for name in FURNITURE_PACKAGES]
    if "airplane" in config.categories:
        sources.append((AIRCRAFT_PACKAGE, _aircraft))
    found = []
    for name, reader in tqdm(sources, desc="packages", unit="package", disable=not config.progress):
        try:
            found.append((_locate(name, config, downloads), reader))
        except packages.PackageMissing as missing:
            if name != FURNITURE_PACKAGES[1]:
                raise
            notes.append(f"done without {name}: {missing}")

    models: list[Model] = []
    dropped: list[Dropped] = []
    ignored = 0
    names: set[str] = set()
    known: dict[str, list[tuple[str, np.ndarray, np.ndarray]]] = {category: [] for category in CATEGORIES}
    for package, reader in found:
        for candidate in reader(package, config):
            if candidate is None:
                ignored += 1
                continue
            outcome = _keep(candidate, known[candidate.category], config, folder, names)
            (models if isinstance(outcome, Model) else dropped).append(outcome)
        for path, content in packages.read_package(package, (f"/doc/{package.name}/copyright",)):
            (folder / "licences").mkdir(exist_ok=True)
            (folder / "licences" / f"{PurePosixPath(path).parent.name}.copyright").write_bytes(content)
    models.sort(key=lambda model: (CATEGORIES.index(model.category), model.file))
    dropped.sort(key=lambda drop: (CATEGORIES.index(drop.category), drop.package, drop.source))
    _write_table(folder / "index.csv", Model, models)
    _write_table(folder / "dropped.csv", Dropped, dropped)
    return Report(config.output, tuple(models), tuple(dropped), ignored, tuple(notes))


def _locate(name: str, config: FetchConfig, downloads: Path) -> packages.Package:
    if config.packages_dir is not None:
        return packages.find_package(name, config.packages_dir)
    if config.root is not None:
        return packages.installed_package(name, config.root)
    return packages.download_package(name, downloads)


def _keep(candidate: Candidate, known: list, config: FetchConfig, folder: Path, names: set[str]) -> Model | Dropped:
    """Clean one candidate, compare it with those kept before it in its category, and write it or say why not."""

    def drop(reason: str) -> Dropped:
        return Dropped(candidate.category, candidate.title, candidate.package.name, candidate.source, reason)

    if isinstance(candidate.mesh, str):
        return drop(candidate.mesh)
    try:
        vertices, faces = clean_mesh(*candidate.mesh)
    except ValueError as error:
        return drop(f"unreadable ({error})")
    grids = surface_grid(vertices, faces, GRID), surface_grid(vertices, faces, GRID, per_axis=True)
    for name, *others in known:
        iou = max(overlap(mine, other) for mine, other in zip(grids, others, strict=True))
        if iou > config.duplicate_iou:
            return drop(f"near-duplicate of {name} (surface IoU {iou:.3f})")
    stem = re.sub(r"[^a-z0-9]+", "-", candidate.stem.lower()).strip("-") or "model"
    name, number = f"{candidate.category}/{stem}", 1
    while name in names:
        number += 1
        name = f"{candidate.category}/{stem}-{number}"
    names.add(name)
    known.append((name, *grids))
    (folder / candidate.category).mkdir(exist_ok=True)
    write_ply(folder / f"{name}.ply", vertices, faces)
    return Model(
        category=candidate.category,
        file=f"{name}.ply",
        title=candidate.title,
        author=candidate.author,
        licence=candidate.licence,
        package=candidate.package.name,
        version=candidate.package.version,
        source=candidate.source,
        vertices=len(vertices),
        faces=len(faces),
        watertight=is_watertight(faces),
    )


def _write_table(path: Path, kind: type, rows: list) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(kind)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
