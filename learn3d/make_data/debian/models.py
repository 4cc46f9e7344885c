"""Real meshes from Debian packages: chairs, tables, cabinets, sofas, lamps (Sweet Home 3D) and airplanes (FlightGear).

`fetch_debian_models` writes OUTPUT/CATEGORY/NAME.ply, welded, y up, facing +z, box centred at the origin, longest side
1, with OUTPUT/index.csv (what each mesh is and under which licence), OUTPUT/dropped.csv (what was left out and why)
and OUTPUT/licences (the packages' copyright files). The same packages give the same bytes.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
from pydantic import Field

from learn3d.files import limits, sandbox
from learn3d.files.findings import DamagedFile, MissingFile
from learn3d.files.writing import write_bytes
from learn3d.make_data.debian import packages
from learn3d.make_data.debian.aircraft import AIRCRAFT_PACKAGE, aircraft_models
from learn3d.make_data.debian.furniture import FURNITURE_PACKAGES, furniture_models
from learn3d.make_data.debian.mesh_cleaning import clean_mesh, overlap, surface_grid
from learn3d.make_data.folders import publishing
from learn3d.settings import FilePath, checked, split_names

CATEGORIES = ("airplane", "chair", "table", "cabinet", "sofa", "lamp")
GRID = 24  # cells per side when surfaces are compared
Overlap = Annotated[float, Field(gt=0, le=1)]
INDEX = ("category", "file", "title", "author", "licence", "package", "version", "source")
INDEX += ("vertices", "faces", "watertight")  # columns of index.csv; watertight: each edge belongs to exactly two faces
DROPPED = ("category", "title", "package", "source", "reason")  # columns of dropped.csv


@checked
class FetchConfig:
    """Categories, packages and duplicates of `fetch_debian_models`."""

    output: FilePath
    """Folder to write."""
    category: str = ",".join(CATEGORIES)
    """Categories, separated by commas."""
    packages_dir: FilePath | None = None
    """Folder with the .deb files (default: apt-get downloads them)."""
    overwrite: bool = False
    """Replace an earlier output."""
    duplicate_iou: Overlap = 0.85
    """Two surfaces whose overlap is greater are one model; 1 keeps all."""
    stretched_iou: Overlap = 0.85
    """Two surfaces whose overlap is greater when both boxes are stretched to cubes are one model; 1 keeps stretched
    copies."""

    def __post_init__(self) -> None:
        if not self.categories or set(self.categories) - set(CATEGORIES):
            raise ValueError(f"category must be some of {','.join(CATEGORIES)}; got {self.category!r}")

    @property
    def categories(self) -> tuple[str, ...]:
        return split_names(self.category)


@dataclass(frozen=True)
class Report:
    """The outcome of `fetch_debian_models`."""

    output: Path
    models: list[dict]  # rows of index.csv, a mesh each
    dropped: list[dict]  # rows of dropped.csv: models of wanted categories that were not written
    ignored: int  # models of other categories
    notes: list[str]  # optional packages that were not there

    def summary(self) -> str:
        """A few lines for a person: counts per category, reasons of what was dropped, notes."""
        kept = Counter(model["category"] for model in self.models)
        closed = Counter(model["category"] for model in self.models if model["watertight"])
        lines = [f"{category:9s}{kept[category]:5d} meshes, {closed[category]} watertight" for category in kept]
        reasons = Counter(re.sub(r" \(.*| of .*", "", drop["reason"]) for drop in self.dropped)
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
    with publishing(output.parent, [output.name]) as scratch:
        report = _write_models(config, scratch / output.name, scratch, progress)
    return report


def _write_models(config: FetchConfig, folder: Path, downloads: Path, progress: bool) -> Report:
    """Write meshes, tables and copyright files into `folder`, which is made."""
    folder.mkdir()
    notes, dropped, ignored, kept = [], [], 0, _Kept(config, folder)
    for package, read in _packages(config, downloads, notes):
        for candidate in read(package, licences=folder / "licences", progress=progress):
            if candidate is None:
                ignored += 1
                continue
            try:
                kept.add(candidate)
            except ValueError as reason:
                names = candidate.category, candidate.title, package.name, candidate.source
                dropped.append(dict(zip(DROPPED, (*names, str(reason)), strict=True)))
    kept.rows.sort(key=lambda row: (CATEGORIES.index(row["category"]), row["file"]))
    dropped.sort(key=lambda row: (CATEGORIES.index(row["category"]), row["package"], row["source"]))
    for name, columns, rows in (("index.csv", INDEX, kept.rows), ("dropped.csv", DROPPED, dropped)):
        with (folder / name).open("w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, columns, lineterminator="\n")
            table.writeheader()
            table.writerows(rows)
    return Report(config.output, kept.rows, dropped, ignored, notes)


def _packages(
    config: FetchConfig, downloads: Path, notes: list[str]
) -> list[tuple[packages.Package, Callable[..., Iterator[packages.Candidate | None]]]]:
    """The packages with models of the wanted categories and their readers; adds to `notes` those that are missing."""
    readers = {}
    if set(config.categories) - {"airplane"}:
        readers = dict.fromkeys(FURNITURE_PACKAGES, partial(furniture_models, categories=config.categories))
    if "airplane" in config.categories:
        readers[AIRCRAFT_PACKAGE] = aircraft_models
    found = []
    for name, read in readers.items():
        try:
            if config.packages_dir is None:
                found.append((packages.download_package(name, downloads), read))
            else:
                found.append((packages.find_package(name, config.packages_dir), read))
        except packages.PackageMissing as missing:
            if name != FURNITURE_PACKAGES[1]:
                raise
            notes.append(f"done without {name}: {missing}")
    return found


class _Kept:
    """The models that were written, each with its surface in two grids to compare the next ones with."""

    def __init__(self, config: FetchConfig, folder: Path) -> None:
        self.rows: list[dict] = []  # of index.csv
        self._config, self._folder = config, folder
        self._grids: dict[str, dict[str, list[np.ndarray]]] = {name: {} for name in CATEGORIES}

    def add(self, candidate: packages.Candidate) -> None:
        """Write the candidate's mesh; raise ValueError with the reason if it is left out."""
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
        self.rows.append(dict(zip(INDEX, (candidate.category, f"{name}.ply", *said, *size), strict=True)))


def _prepare(
    package: Path, read: Callable[[], tuple[np.ndarray, np.ndarray]]
) -> tuple[trimesh.Trimesh, list[np.ndarray]]:
    """In a worker: clean a model of the package; its surface in two grids, in proportion and stretched to a cube."""
    try:
        mesh = clean_mesh(*read())
    except ValueError as error:
        raise DamagedFile(package, str(error)) from error
    return mesh, [surface_grid(mesh.vertices, mesh.faces, GRID, per_axis=cube) for cube in (False, True)]


def _is_ours(index: Path) -> bool:
    """Whether a table begins as index.csv does."""
    if not index.is_file():
        return False
    with index.open(encoding="utf-8", errors="replace") as file:
        return file.readline(1000).strip() == ",".join(INDEX)
