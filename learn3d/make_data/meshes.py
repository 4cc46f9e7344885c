"""Sources of meshes: a folder of files, a mesh pack (npz) or the procedural generator.

Every source is a list of `MeshSource`, in an order that does not depend on the file system. Reading one raises
ValueError if the file cannot be read, and `checked` if a mesh cannot be used, each with the reason.
"""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from learn3d.files import npz, sandbox
from learn3d.files.meshes import EXTENSIONS, RawMesh, read_mesh

if TYPE_CHECKING:  # workers read meshes without torch
    from learn3d.make_data.config import DatasetConfig

SIDECARS = (".mtl", ".bin", ".png", ".jpg", ".jpeg", ".txt", ".md", ".json")  # files that belong beside meshes


@dataclass(frozen=True)
class MeshSource:
    """A mesh that can be read when its turn comes."""

    name: str  # unique within its source: path relative to the folder, or the number in the pack
    read: Callable[[], RawMesh]  # it can be pickled


def list_sources(config: DatasetConfig) -> tuple[list[MeshSource], dict[str, int]]:
    """The meshes that `config` names, and the number of other files beside them per extension."""
    if config.procedural:
        return procedural_sources(config.category, config.procedural, config.seed), {}
    source = Path(config.source)
    if source.is_dir():
        return folder_sources(source)
    if source.is_file() and source.suffix == ".npz":
        return pack_sources(source), {}
    if source.exists():
        raise ValueError(f"the source must be a folder of meshes or a mesh pack (.npz), got the file {source}")
    raise FileNotFoundError(f"there is no folder or mesh pack {source}")


def folder_sources(folder: Path) -> tuple[list[MeshSource], Counter[str]]:
    """The mesh files below a folder, sorted by relative path, and how many files of which other extension it ignored.

    Raises ValueError if the folder holds no mesh file.
    """
    files = sorted((p for p in folder.rglob("*") if p.is_file()), key=lambda p: p.relative_to(folder).as_posix())
    meshes = [path for path in files if path.suffix.lower() in EXTENSIONS]
    ignored = Counter(p.suffix.lower() or "(none)" for p in files if p.suffix.lower() not in EXTENSIONS + SIDECARS)
    if not meshes:
        raise ValueError(
            f"no mesh file in {folder} or below it: wanted {', '.join(EXTENSIONS)}, "
            f"found {dict(ignored) or 'nothing'}; convert the meshes to one of these, or give another folder"
        )
    return [
        MeshSource(p.relative_to(folder).as_posix(), functools.partial(read_mesh, p, folder)) for p in meshes
    ], ignored


def pack_sources(path: Path) -> list[MeshSource]:
    """The meshes of a pack: an npz file with `n` and v0 float [V, 3], f0 int [F, 3], v1, f1, ... (never pickled).

    Raises ValueError if the file is no such pack.
    """
    wanted = "an npz file with n (how many), v0, f0, v1, f1, ... and no pickled objects"
    try:
        there = set(sandbox.read(npz.keys, path, wanted=wanted))
        number = sandbox.read(npz.read, path, "n", 8, wanted=wanted) if "n" in there else np.array(None)
    except ValueError as error:
        raise ValueError(f"cannot read the mesh pack {error}") from error
    count = int(number.reshape(())) if number.size == 1 and number.dtype.kind in "iu" else -1
    missing = [key for i in range(min(count, len(there))) for key in (f"v{i}", f"f{i}") if key not in there][:4]
    if count < 1 or missing:
        raise ValueError(f"{path} is no mesh pack: it must be {wanted}; n is {number}, missing keys: {missing}")
    width = len(str(count - 1))
    return [MeshSource(f"{i:0{width}d}", functools.partial(_packed, path, i, wanted)) for i in range(count)]


def _packed(path: Path, number: int, wanted: str) -> RawMesh:
    vertices, faces = (sandbox.read(npz.read, path, f"{kind}{number}", wanted=wanted) for kind in "vf")
    return RawMesh(vertices, faces)


def procedural_sources(category: str, count: int, seed: int) -> list[MeshSource]:
    """`count` shapes of the procedural generator; shape i depends on the seed and i alone."""
    from learn3d.make_data.shapes import CATEGORIES

    if category not in CATEGORIES:
        raise ValueError(f"the procedural generator makes {', '.join(CATEGORIES)}; got category {category!r}")
    return [MeshSource(f"{category}_{i:05d}", functools.partial(_procedural, category, seed, i)) for i in range(count)]


def _procedural(category: str, seed: int, number: int) -> RawMesh:
    from learn3d.make_data.shapes import make_shape

    shape = make_shape(category, np.random.default_rng([seed, 0, number]))
    return RawMesh(shape.vertices, shape.faces)


def object_names(sources: list[MeshSource]) -> list[str]:
    """A name for each mesh that can be part of a file name, all different: letters, digits and underscores."""
    names, taken, tried = [], set(), Counter()
    for source in sources:
        plain = re.sub(r"\W+", "_", str(Path(source.name).with_suffix(""))).strip("_")[-80:] or "mesh"
        plain = plain.encode()[-240:].decode(errors="ignore")  # names of files have 255 bytes
        key = plain.lower()
        while (name := f"{plain}_{tried[key] + 1}" if tried[key] else plain).lower() in taken:
            tried[key] += 1
        taken.add(name.lower())
        names.append(name)
    return names


def checked(mesh: RawMesh, max_faces: int) -> RawMesh:
    """The mesh with the vertices that no face uses dropped; ValueError with the reason if it cannot be rendered."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"not a triangle mesh: vertices {list(vertices.shape)}, faces {list(faces.shape)}")
    if not np.issubdtype(faces.dtype, np.integer) or not np.issubdtype(vertices.dtype, np.number):
        raise ValueError(f"not a triangle mesh: vertices are {vertices.dtype}, faces are {faces.dtype}")
    if len(faces) == 0:
        raise ValueError("no faces")
    if len(faces) > max_faces:
        raise ValueError(f"too large: {len(faces)} faces, the limit is {max_faces} (max_faces)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces refer to vertices {faces.min()} .. {faces.max()}, there are {len(vertices)}")
    used, faces = np.unique(faces, return_inverse=True)
    vertices = vertices[used].astype(np.float64)
    if not np.isfinite(vertices).all():
        raise ValueError("vertices that are not finite (NaN or infinite)")
    with np.errstate(over="ignore"):
        extent = float(np.ptp(vertices, axis=0).max())
    if not 1e-12 < extent < 1e30:
        raise ValueError(f"no usable extent: its longest side is {extent:g}")
    return replace(mesh, vertices=vertices, faces=faces.reshape(-1, 3).astype(np.int64))


def fit_to_box(vertices: np.ndarray) -> np.ndarray:
    """Vertices [V, 3] with their bounding box centred at the origin and its longest side 1."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return (vertices - (low + high) / 2) / (high - low).max()


def is_watertight(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """True if every edge has exactly two faces: by vertex number, or with vertices at equal positions taken as one.

    The second suits formats that repeat vertices (STL); the first, closed parts that touch each other.
    """
    place = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)
    for corners in (faces, place[faces]):
        corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]  # degenerate faces close nothing
        if len(corners) and trimesh.graph.is_watertight(trimesh.geometry.faces_to_edges(corners))[0]:
            return True
    return False
