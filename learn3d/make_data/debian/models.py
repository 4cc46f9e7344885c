"""Real meshes from Debian packages: chairs, tables, cabinets, sofas, lamps (Sweet Home 3D) and airplanes (FlightGear).

`fetch_debian_models` writes OUTPUT/CATEGORY/NAME.ply, welded, y up, facing +z, box centred at the origin, longest side
1, with OUTPUT/index.csv (what each mesh is and under which licence), OUTPUT/dropped.csv (what was left out and why)
and OUTPUT/licences (the packages' copyright files). The same packages give the same bytes.
"""

from __future__ import annotations

import csv
import os
import re
import tempfile
from collections import Counter
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from learn3d.files import limits
from learn3d.files.reading import within
from learn3d.files.writing import write_bytes
from learn3d.interrupt import stop_on_signal
from learn3d.make_data.debian import packages
from learn3d.make_data.debian.aircraft import AIRCRAFT_PACKAGE, aircraft_models
from learn3d.make_data.debian.furniture import FURNITURE_PACKAGES, furniture_models
from learn3d.make_data.mesh_cleaning import clean_mesh, overlap, surface_grid

CATEGORIES = ("airplane", "chair", "table", "cabinet", "sofa", "lamp")
GRID = 24  # cells per side when surfaces are compared


@dataclass(frozen=True)
class FetchConfig:
    """What to take from where."""

    output: Path
    """folder to write"""
    category: tuple[str, ...] = CATEGORIES
    """which of the six categories"""
    packages_dir: Path | None = None
    """folder with the .deb files; without it they are downloaded with apt-get"""
    root: Path | None = None
    """take the packages as installed below this folder ("/" for this machine)"""
    overwrite: bool = False
    """replace an earlier output"""
    duplicate_iou: float = 0.85
    """two surfaces whose overlap is greater are one model; 1 keeps all"""
    stretched_iou: float = 0.85
    """the same with both boxes stretched to cubes; 1 keeps stretched copies"""
    progress: bool = True
    """draw progress bars"""


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
        lines.append(f"{self.ignored} models of other categories or parts")
        return "\n".join([*lines, *self.notes, f"written to {self.output}"])


def fetch_debian_models(config: FetchConfig) -> Report:
    """Write the meshes that `config` names into its output folder; the folder appears at once or not at all.

    Raises ValueError (a sentence that says what to do) for unknown categories, an output that is there already, a
    package that cannot be had, and archives that are damaged or unsafe. An unreadable model is reported, not raised.
    """
    unknown = [name for name in config.category if name not in CATEGORIES]
    if unknown or not config.category:
        raise ValueError(f"category must be some of {', '.join(CATEGORIES)}; got {', '.join(unknown) or 'none'}")
    if config.packages_dir is not None and config.root is not None:
        raise ValueError("give either --packages-dir or --root, not both")
    for field in ("duplicate_iou", "stretched_iou"):
        if not 0 < getattr(config, field) <= 1:
            raise ValueError(f"{field} must be in (0, 1], got {getattr(config, field)}")
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
        with stop_on_signal():  # not between the two
            if output.exists():
                os.replace(output, Path(scratch, "old"))
            os.replace(written, output)
    return report


def _write_all(config: FetchConfig, folder: Path, downloads: Path) -> Report:
    """The body of `fetch_debian_models`: models, tables and copyright files into `folder`."""
    common = {"licences": folder / "licences", "progress": config.progress}
    wanted = []
    if set(config.category) - {"airplane"}:
        furniture = partial(furniture_models, categories=config.category, **common)
        wanted += [(name, furniture) for name in FURNITURE_PACKAGES]
    if "airplane" in config.category:
        wanted.append((AIRCRAFT_PACKAGE, partial(aircraft_models, **common)))
    found, notes = [], []
    for name, reader in tqdm(wanted, desc="finding packages", disable=not config.progress, leave=False):
        try:
            found.append((_locate(name, config, downloads), reader))
        except packages.PackageMissing as missing:
            if name != FURNITURE_PACKAGES[1]:
                raise
            notes.append(f"done without {name}: {missing}")

    kept, models, dropped, ignored = _Kept(config, folder), [], [], 0
    for package, reader in found:
        for candidate in reader(package):
            if candidate is None:
                ignored += 1
                continue
            try:
                models.append(kept.add(candidate))
            except ValueError as reason:
                names = candidate.category, candidate.title, package.name, candidate.source
                dropped.append(Dropped(*names, str(reason)))
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


class _Kept:
    """The models that were written, each with its surface in two grids, for the next ones to be compared with."""

    def __init__(self, config: FetchConfig, folder: Path) -> None:
        self._config, self._folder = config, folder
        self._grids: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {name: {} for name in CATEGORIES}

    def add(self, candidate: packages.Candidate) -> Model:
        """Write the candidate's mesh; ValueError, with the reason, where it is left out."""
        try:
            with within(limits.MESH_SECONDS, limits.MESH_MEMORY):
                mesh = clean_mesh(*candidate.read())
                grids = tuple(surface_grid(mesh.vertices, mesh.faces, GRID, per_axis=cubes) for cubes in (False, True))
        except ValueError as error:
            raise ValueError(f"unreadable ({error})") from error
        known = self._grids[candidate.category]
        for name, others in known.items():
            iou, stretched = (overlap(mine, other) for mine, other in zip(grids, others, strict=True))
            if iou > self._config.duplicate_iou:
                raise ValueError(f"near-duplicate of {name} (surface IoU {iou:.3f})")
            if stretched > self._config.stretched_iou:
                raise ValueError(f"stretched near-duplicate of {name} (surface IoU {stretched:.3f} as cubes)")
        stem = re.sub(r"[^a-z0-9]+", "-", candidate.stem.lower()).strip("-") or "model"
        name, number = f"{candidate.category}/{stem}", 1
        while name in known:
            number += 1
            name = f"{candidate.category}/{stem}-{number}"
        known[name] = grids
        (self._folder / candidate.category).mkdir(exist_ok=True)
        write_bytes(self._folder / f"{name}.ply", mesh.export(file_type="ply"))
        return Model(
            category=candidate.category,
            file=f"{name}.ply",
            title=candidate.title,
            author=candidate.author,
            licence=candidate.licence,
            package=candidate.package.name,
            version=candidate.package.version,
            source=candidate.source,
            vertices=len(mesh.vertices),
            faces=len(mesh.faces),
            watertight=mesh.is_watertight,
        )


def _write_table(path: Path, kind: type, rows: list) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(kind)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
