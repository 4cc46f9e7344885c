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
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
from pydantic import Field
from tqdm import tqdm

from learn3d.files import limits, sandbox
from learn3d.files.findings import DamagedFile, MissingFile
from learn3d.files.writing import write_bytes
from learn3d.make_data.debian import packages
from learn3d.make_data.debian.aircraft import AIRCRAFT_PACKAGE, aircraft_models
from learn3d.make_data.debian.furniture import FURNITURE_PACKAGES, furniture_models
from learn3d.make_data.mesh_cleaning import clean_mesh, overlap, surface_grid
from learn3d.settings import FilePath, checked
from learn3d.terminal import stop_on_signal

CATEGORIES = ("airplane", "chair", "table", "cabinet", "sofa", "lamp")
GRID = 24  # cells per side when surfaces are compared
Overlap = Annotated[float, Field(gt=0, le=1)]
Grids = tuple[np.ndarray, np.ndarray]  # in proportion, and stretched to a cube


@checked
class FetchConfig:
    """What to take from where."""

    output: FilePath
    """Folder to write."""
    category: str = ",".join(CATEGORIES)
    """Which of the six categories, separated by commas."""
    packages_dir: FilePath | None = None
    """Folder with the .deb files. None: they are downloaded with apt-get."""
    overwrite: bool = False
    """Replace an earlier output."""
    duplicate_iou: Overlap = 0.85
    """Two surfaces whose overlap is greater are one model; 1 keeps all."""
    stretched_iou: Overlap = 0.85
    """The same with both boxes stretched to cubes; 1 keeps stretched copies."""

    def __post_init__(self) -> None:
        if not self.categories or set(self.categories) - set(CATEGORIES):
            raise ValueError(f"category must be some of {','.join(CATEGORIES)}; got {self.category!r}")

    @property
    def categories(self) -> tuple[str, ...]:
        return tuple(name.strip() for name in self.category.split(",") if name.strip())


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
    models: list[Model]
    dropped: list[Dropped]
    ignored: int  # models of other categories
    notes: list[str]  # optional packages that were not there

    def summary(self) -> str:
        """A few lines for a person: counts per category, reasons of what was dropped, notes."""
        kept = Counter(model.category for model in self.models)
        closed = Counter(model.category for model in self.models if model.watertight)
        lines = [f"{category:9s}{kept[category]:5d} meshes, {closed[category]} watertight" for category in kept]
        reasons = Counter(re.sub(r" \(.*| of .*", "", drop.reason) for drop in self.dropped)
        lines += [f"{count} dropped: {reason}" for reason, count in reasons.most_common()]
        lines.append(f"{self.ignored} models of other categories or parts")
        return "\n".join([*lines, *self.notes, f"written to {self.output}"])


def fetch_debian_models(config: FetchConfig, progress: bool = True) -> Report:
    """Write the meshes that `config` names into its output folder; the folder appears at once or not at all.

    Raises ValueError (a sentence that says what to do) for an output that is there already, a package that cannot be
    had, and archives that are damaged. A model that cannot be read is reported, not raised.
    """
    output = config.output.resolve()
    if output.exists():
        if not config.overwrite:
            raise ValueError(f"{config.output} is there already; remove it, or replace it with --overwrite")
        if not _is_ours(output / "index.csv"):
            raise ValueError(f"{config.output} was not written by this tool (no such index.csv); choose another folder")
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as scratch:
        written, downloads = Path(scratch, "models"), Path(scratch, "packages")
        written.mkdir()
        downloads.mkdir()
        report = _write_all(config, written, downloads, progress)
        with stop_on_signal():  # not between the two
            if output.exists():
                os.replace(output, Path(scratch, "old"))
            os.replace(written, output)
    return report


def _write_all(config: FetchConfig, folder: Path, downloads: Path, progress: bool) -> Report:
    """The body of `fetch_debian_models`: models, tables and copyright files into `folder`."""
    common = {"licences": folder / "licences", "progress": progress}
    readers = {}
    if set(config.categories) - {"airplane"}:
        readers = dict.fromkeys(FURNITURE_PACKAGES, partial(furniture_models, categories=config.categories, **common))
    if "airplane" in config.categories:
        readers[AIRCRAFT_PACKAGE] = partial(aircraft_models, **common)
    found, notes, models, dropped, ignored = [], [], [], [], 0
    for name in tqdm(readers, desc="finding packages", disable=not progress, leave=False):
        try:
            if config.packages_dir is None:
                found.append(packages.download_package(name, downloads))
            else:
                found.append(packages.find_package(name, config.packages_dir))
        except packages.PackageMissing as missing:
            if name != FURNITURE_PACKAGES[1]:
                raise
            notes.append(f"done without {name}: {missing}")
    kept = _Kept(config, folder)
    for package in found:
        for candidate in readers[package.name](package):
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
    return Report(config.output, models, dropped, ignored, notes)


class _Kept:
    """The models that were written, each with its surface in two grids, for the next ones to be compared with."""

    def __init__(self, config: FetchConfig, folder: Path) -> None:
        self._config, self._folder = config, folder
        self._grids: dict[str, dict[str, Grids]] = {name: {} for name in CATEGORIES}

    def add(self, candidate: packages.Candidate) -> Model:
        """Write the candidate's mesh; ValueError, with the reason, where it is left out."""
        package, known = candidate.package, self._grids[candidate.category]
        try:
            mesh, grids = sandbox.read(_prepare, package.path, candidate.read, memory=2 * limits.GIB, seconds=60.0)
        except (DamagedFile, MissingFile) as error:
            raise ValueError(f"unreadable ({error.message})") from error
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
        file = self._folder / f"{name}.ply"
        file.parent.mkdir(exist_ok=True)
        write_bytes(file, mesh.export(file_type="ply"))
        said = candidate.title, candidate.author, candidate.licence, package.name, package.version, candidate.source
        size = len(mesh.vertices), len(mesh.faces), mesh.is_watertight
        return Model(candidate.category, f"{name}.ply", *said, *size)


def _prepare(package: Path, read: Callable[[], tuple[np.ndarray, np.ndarray]]) -> tuple[trimesh.Trimesh, Grids]:
    """In a worker: a model of the package made fit, and its surface in two grids."""
    try:
        mesh = clean_mesh(*read())
    except ValueError as error:
        raise DamagedFile(package, str(error)) from error
    whole, cube = (surface_grid(mesh.vertices, mesh.faces, GRID, per_axis=cubes) for cubes in (False, True))
    return mesh, (whole, cube)


def _is_ours(index: Path) -> bool:
    """Whether a table begins as index.csv does."""
    if not index.is_file():
        return False
    with index.open(encoding="utf-8", errors="replace") as file:
        return file.readline(1000).strip() == ",".join(field.name for field in fields(Model))


def _write_table(path: Path, kind: type, rows: list) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(kind)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
