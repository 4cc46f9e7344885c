"""Real meshes from Debian packages: chairs, tables, cabinets, sofas, lamps (Sweet Home 3D) and airplanes (FlightGear).

`fetch_debian_models` writes OUTPUT/CATEGORY/NAME.ply: welded, y up, front +z, box centred at the origin, longest side
1. OUTPUT/index.csv has the source and licence of each mesh, OUTPUT/licences the packages' copyright files. The same
packages give the same bytes.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import trimesh
from tqdm import tqdm

from learn3d import settings
from learn3d.files.writing import publishing
from learn3d.make_data.debian.aircraft import AIRCRAFT_PACKAGE, aircraft_models
from learn3d.make_data.debian.furniture import FURNITURE_PACKAGES, furniture_models
from learn3d.make_data.debian.packages import Candidate, get_package, read_package
from learn3d.make_data.meshes import RawMesh, check, fit_to_box

CATEGORIES = ("airplane", "chair", "table", "cabinet", "sofa", "lamp")
PACKAGES = {name: furniture_models for name in FURNITURE_PACKAGES} | {AIRCRAFT_PACKAGE: aircraft_models}
GRID = 24  # cells per side of the grids that are compared to find duplicates
MAX_SAMPLES = 2_000_000  # surface points in memory at a time
DUPLICATE_IOU = 0.85  # two models whose surface grids have a larger IoU are duplicates
INDEX = ("category", "file", "title", "author", "licence", "package", "version", "source")
INDEX += ("vertices", "faces", "watertight")  # columns of index.csv; watertight: each edge belongs to exactly two faces


@settings.checked
class FetchConfig:
    """Options of `fetch_debian_models`."""

    output: settings.FilePath
    """Folder to write; it must not exist."""
    packages_dir: settings.FilePath | None = None
    """Folder for the .deb files; missing ones are downloaded into it (default: a temporary folder)."""


@dataclass
class Report:
    """The outcome of `fetch_debian_models`."""

    models: list[dict] = field(default_factory=list)  # rows of index.csv, one for each mesh
    dropped: dict[str, str] = field(default_factory=dict)  # source of each skipped model -> reason
    notes: list[str] = field(default_factory=list)  # missing optional packages

    def summary(self) -> str:
        """Lines for the terminal: meshes per category, skipped models per reason, notes."""
        lines = [f"{name:9s}{n:5d} meshes" for name, n in Counter(row["category"] for row in self.models).items()]
        reasons = Counter(reason.split(" of ")[0] for reason in self.dropped.values())
        return "\n".join([*lines, *(f"{n} skipped: {reason}" for reason, n in reasons.most_common()), *self.notes])


def fetch_debian_models(config: FetchConfig, progress: bool = True) -> Report:
    """Write the meshes into the output folder. The folder appears when it is complete.

    The report lists unreadable models and duplicates. Raises ValueError if the output exists, or if a package is
    missing or damaged.
    """
    output, report = config.output.resolve(), Report()
    if output.exists():
        raise ValueError(f"{config.output} already exists; remove it, or give another folder")
    output.parent.mkdir(parents=True, exist_ok=True)
    with publishing(output.parent, [output.name]) as scratch:
        folder, kept = scratch / output.name, {category: {} for category in CATEGORIES}
        (folder / "licences").mkdir(parents=True)
        for name, find_models in PACKAGES.items():
            try:
                package = get_package(name, config.packages_dir or scratch)
            except ValueError as missing:
                if not name.endswith("-nonfree"):
                    raise
                report.notes.append(f"without the optional package {name}: {missing}")
                continue
            files = read_package(package, (".sh3f", ".ac", ".xml", notice := f"/doc/{name}/copyright"))
            for path in [path for path in files if path.endswith(notice)]:
                (folder / "licences" / f"{name}.copyright").write_bytes(files[path])
            about = {"package": name, "version": unquote(package.stem.split("_")[1])}
            for model in tqdm(find_models(files), desc=name, unit="model", disable=not progress, leave=False):
                try:
                    report.models.append(about | _write_model(model, folder, kept[model.category]))
                except ValueError as reason:
                    report.dropped[model.source] = str(reason)
        report.models.sort(key=lambda row: (CATEGORIES.index(row["category"]), row["file"]))
        with (folder / "index.csv").open("w", newline="", encoding="utf-8") as file:
            rows = [[row[column] for column in INDEX] for row in report.models]
            csv.writer(file, lineterminator="\n").writerows([INDEX, *rows])
    return report


def _write_model(model: Candidate, folder: Path, kept: dict[str, list[np.ndarray]]) -> dict:
    """Write a mesh, add its grids to `kept`, and return its row of index.csv.

    kept: name -> [surface grid, surface grid stretched to a cube] of the category's meshes. Raises ValueError if the
    model cannot be read or is a near-duplicate of a kept one.
    """
    mesh = clean_mesh(*model.read())
    surface = [surface_grid(mesh.vertices, mesh.faces, GRID, per_axis=cube) for cube in (False, True)]
    for name, others in kept.items():
        for kind, mine, other in zip(("", "stretched "), surface, others, strict=True):
            iou = np.count_nonzero(mine & other) / np.count_nonzero(mine | other)
            if iou > DUPLICATE_IOU:
                raise ValueError(f"{kind}near-duplicate of {name} (surface IoU {iou:.3f})")
    stem = f"{model.category}/" + (re.sub(r"[^a-z0-9]+", "-", model.stem.lower()).strip("-") or "model")
    name, number = stem, 1
    while name in kept:
        number += 1
        name = f"{stem}-{number}"
    kept[name] = surface
    (folder / model.category).mkdir(exist_ok=True)
    (folder / f"{name}.ply").write_bytes(mesh.export(file_type="ply"))
    size = {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "watertight": mesh.is_watertight}
    return model._asdict() | {"file": f"{name}.ply"} | size


def clean_mesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    """The welded mesh, its bounding box centred at the origin, its longest side 1.

    Merges vertices closer than about 1e-5 of the longest side. Removes faces without area, repeated faces (of either
    winding) and unused vertices. Raises ValueError if the mesh is flat or empty, or a coordinate is not finite.
    """
    raw = check(RawMesh(vertices, faces))
    mesh = trimesh.Trimesh(fit_to_box(raw.vertices), raw.faces, process=False)
    mesh.merge_vertices(digits_vertex=5)
    mesh.update_faces((mesh.area_faces > 1e-12) & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) == 0:
        raise ValueError("no face has an area")
    if mesh.extents.min() < 1e-3 * mesh.extents.max():
        raise ValueError("it is flat")
    mesh.vertices = fit_to_box(mesh.vertices)
    return mesh


def surface_grid(vertices: np.ndarray, faces: np.ndarray, size: int, per_axis: bool = False) -> np.ndarray:
    """Grid bool [size, size, size] of the cells with a surface sample; samples are at most a third of a cell apart.

    The bounding box is centred in the grid. Its longest side, or with `per_axis` each side, fills the grid.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = high - low if per_axis else (high - low).max()
    corners = (((vertices - (low + high) / 2) / scale + 0.5) * size)[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(3 * edges).astype(np.int64), 1)
    grid = np.zeros((size, size, size), dtype=bool)
    for count in np.unique(steps):
        i, j = np.divmod(np.arange((count + 1) ** 2), count + 1)
        i, j = i[i + j <= count], j[i + j <= count]
        weights = np.stack([i, j, count - i - j], axis=1) / count
        chosen = corners[steps == count]
        for part in np.array_split(chosen, 1 + len(chosen) * len(weights) // MAX_SAMPLES):
            cells = np.clip(np.floor((weights @ part).reshape(-1, 3)).astype(np.int64), 0, size - 1)
            grid[tuple(cells.T)] = True
    return grid
