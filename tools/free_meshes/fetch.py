"""Extracts airplanes, chairs, tables, cabinets, sofas and lamps from Debian's packages, as PLY.

python tools/free_meshes/fetch.py --output models

It writes OUTPUT/CATEGORY/NAME.ply: welded, y up, front +z, box centred at the origin, of length 1.
OUTPUT/index.csv has the source and licence of each mesh, OUTPUT/licences the packages' copyright
files. The same packages give the same bytes. It runs on Debian; README.md beside it has more.
"""

import csv
import itertools
import re
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import trimesh
import tyro
from debs import get_package, read_package
from packages import PACKAGES
from tqdm import tqdm

from learn3d.files.formats import RawMesh
from learn3d.files.writing import publishing
from learn3d.studio.make_data.meshes import check, fit_to_box
from learn3d.terminal import is_watched, note, say, without_traceback

PACKAGED_CATEGORIES = ("airplane", "chair", "table", "cabinet", "sofa", "lamp")
GRID = 24  # cells per side of the grids that are compared to find duplicates
MAX_SAMPLES = 2_000_000  # surface points in memory at a time
DUPLICATE_IOU = 0.85  # two models whose surface grids have a larger IoU are duplicates
# Columns of index.csv. In a watertight mesh each edge belongs to exactly two faces.
INDEX = ("category", "file", "title", "author", "licence", "package", "version", "source")
INDEX += ("vertices", "faces", "watertight")


@dataclass
class FetchReport:
    """The outcome of `fetch_models`."""

    models: list[dict] = field(default_factory=list)  # rows of index.csv, one for each mesh
    dropped: dict[str, str] = field(default_factory=dict)  # source of each skipped model -> reason

    def summary(self) -> str:
        """Lines for the terminal: meshes per category, skipped models per reason."""
        lines = [
            f"{name:9s}{n:5d} meshes"
            for name, n in Counter(row["category"] for row in self.models).items()
        ]
        reasons = Counter(reason.split(" of ")[0] for reason in self.dropped.values())
        return "\n".join(
            [*lines, *(f"{n} skipped: {reason}" for reason, n in reasons.most_common())]
        )


def fetch_models(output: Path, packages_dir: Path | None = None) -> FetchReport:
    """Write the meshes into the folder `output`, which appears when it is complete.

    packages_dir: folder of the .deb files, into which missing ones are downloaded (default: a
    temporary folder). The report lists unreadable models and duplicates. Raises ValueError if the
    output exists, or if a package is missing or damaged.
    """
    output, report = output.resolve(), FetchReport()
    if output.exists():
        raise ValueError(f"{output} already exists; remove it, or give another folder")
    output.parent.mkdir(parents=True, exist_ok=True)
    with publishing(output.parent, [output.name]) as scratch:
        folder, kept = scratch / output.name, {category: {} for category in PACKAGED_CATEGORIES}
        (folder / "licences").mkdir(parents=True)
        for name, find_models in PACKAGES.items():
            try:
                package = get_package(name, packages_dir or scratch)
            except ValueError as missing:
                if not name.endswith("-nonfree"):
                    raise
                note(f"without the optional package {name}: {missing}")
                continue
            files = read_package(
                package, (".sh3f", ".ac", ".xml", notice := f"/doc/{name}/copyright")
            )
            for path in [path for path in files if path.endswith(notice)]:
                (folder / "licences" / f"{name}.copyright").write_bytes(files[path])
            about = {"package": name, "version": unquote(package.stem.split("_")[1])}
            for facts, read in tqdm(
                find_models(files), desc=name, unit="model", disable=not is_watched(), leave=False
            ):
                try:
                    mesh = clean_mesh(read())
                    report.models.append(
                        about | facts | _write_model(mesh, facts, folder, kept[facts["category"]])
                    )
                except ValueError as reason:
                    report.dropped[facts["source"]] = str(reason)
        report.models.sort(
            key=lambda row: (PACKAGED_CATEGORIES.index(row["category"]), row["file"])
        )
        with (folder / "index.csv").open("w", newline="", encoding="utf-8") as file:
            rows = [[row[column] for column in INDEX] for row in report.models]
            csv.writer(file, lineterminator="\n").writerows([INDEX, *rows])
    return report


def _write_model(
    mesh: trimesh.Trimesh, facts: dict[str, str], folder: Path, kept: dict[str, list[np.ndarray]]
) -> dict[str, object]:
    """Write a mesh, add its grids to `kept`, and return its columns of index.csv.

    kept: name -> [surface grid, surface grid stretched to a cube] of the category's meshes.
    Raises ValueError if the mesh is a near-duplicate of a kept one.
    """
    stretched = mesh.vertices / np.ptp(mesh.vertices, axis=0)
    surface = [surface_grid(vertices, mesh.faces, GRID) for vertices in (mesh.vertices, stretched)]
    for name, others in kept.items():
        for kind, mine, other in zip(("", "stretched "), surface, others, strict=True):
            iou = np.count_nonzero(mine & other) / np.count_nonzero(mine | other)
            if iou > DUPLICATE_IOU:
                raise ValueError(f"{kind}near-duplicate of {name} (surface IoU {iou:.3f})")
    stem = f"{facts['category']}/" + (
        re.sub(r"[^a-z0-9]+", "-", facts["stem"].lower()).strip("-") or "model"
    )
    free = itertools.chain([stem], (f"{stem}-{n}" for n in itertools.count(2)))
    name = next(name for name in free if name not in kept)
    kept[name] = surface
    (folder / facts["category"]).mkdir(exist_ok=True)
    (folder / f"{name}.ply").write_bytes(mesh.export(file_type="ply"))
    size = {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "watertight": mesh.is_watertight,
    }
    return {"file": f"{name}.ply"} | size


def clean_mesh(raw: RawMesh) -> trimesh.Trimesh:
    """The mesh welded, its bounding box centred at the origin, its longest side 1.

    Merges vertices closer than about 1e-5 of the longest side. Removes faces without area,
    repeated faces (of either winding) and unused vertices. Raises ValueError if the mesh is flat
    or empty, or a coordinate is not finite.
    """
    raw = check(raw)
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


def surface_grid(vertices: np.ndarray, faces: np.ndarray, size: int) -> np.ndarray:
    """Cells with a surface sample, bool [size, size, size]; samples are a third of a cell apart.

    The grid is the cube -0.5 .. 0.5, in which all vertices lie.
    """
    corners = ((vertices + 0.5) * size)[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(3 * edges).astype(np.int64), 1)
    grid = np.zeros((size, size, size), dtype=bool)
    for count in np.unique(steps):
        i, j = np.nonzero(np.tri(count + 1)[::-1])  # i + j <= count
        weights = np.stack([i, j, count - i - j], axis=1) / count
        chosen = corners[steps == count]
        for part in np.array_split(chosen, 1 + len(chosen) * len(weights) // MAX_SAMPLES):
            cells = np.clip(np.floor((weights @ part).reshape(-1, 3)).astype(np.int64), 0, size - 1)
            grid[tuple(cells.T)] = True
    return grid


@without_traceback
def main(output: Path, packages_dir: Path | None = None) -> int:
    """Extract airplanes, chairs, tables, cabinets, sofas and lamps from Debian packages, as PLY.

    output: folder to write; it must not exist. packages_dir: folder for the .deb files; missing
    ones are downloaded into it (default: a temporary folder).
    """
    say(fetch_models(output, packages_dir).summary())
    say(f"written to {output}")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
