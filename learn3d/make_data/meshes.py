"""Sources of meshes: a folder of files, a mesh pack (npz) or the procedural generator."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from learn3d.files import npz, sandbox
from learn3d.files.formats import EXTENSIONS, RawMesh, read_mesh
from learn3d.shapes import CATEGORIES, numbered_shape

MAX_FACES = 1_000_000
Source = Callable[[], RawMesh]  # reads one mesh, or raises ValueError if its file is damaged; can be pickled
_PACK = "an npz file with v0, f0, v1, f1, ... and no pickled objects"


def list_sources(source: Path) -> dict[str, Source]:
    """The meshes of a folder (by relative path, sorted) or of a mesh pack (by number).

    A pack is an npz file with v0 float [V, 3], f0 int [F, 3], v1, f1, ... Raises FileNotFoundError if there is no such
    file or folder, ValueError if it holds no mesh.
    """
    if source.is_dir():
        files = {p.relative_to(source).as_posix(): p for p in source.rglob("*") if p.suffix.lower() in EXTENSIONS}
        found = {name: functools.partial(read_mesh, files[name]) for name in sorted(files)}
    elif source.suffix == ".npz":
        count = sum(bool(re.fullmatch(r"v\d+", key)) for key in sandbox.read(npz.keys, source, wanted=_PACK))
        found = {f"{i:0{len(str(count - 1))}d}": functools.partial(_packed, source, i) for i in range(count)}
    else:
        kind = ValueError if source.exists() else FileNotFoundError
        raise kind(f"the source must be a folder of meshes or a mesh pack (.npz), got {source}")
    if not found:
        raise ValueError(f"there is no mesh in {source}; it must be {_PACK}, or a folder of {', '.join(EXTENSIONS)}")
    return found


def _packed(path: Path, number: int) -> RawMesh:
    return RawMesh(*(sandbox.read(npz.read, path, f"{kind}{number}", wanted=_PACK) for kind in "vf"))


def procedural_sources(category: str, count: int, seed: int) -> dict[str, Source]:
    """`count` shapes of the procedural generator; shape i depends on the seed and i alone."""
    if category not in CATEGORIES:
        raise ValueError(f"the procedural generator makes {', '.join(CATEGORIES)}; got category {category!r}")
    return {f"{category}_{i:05d}": functools.partial(_procedural, category, seed, i) for i in range(count)}


def _procedural(category: str, seed: int, number: int) -> RawMesh:
    shape = numbered_shape(category, seed, number)
    return RawMesh(shape.vertices, shape.faces)


def object_names(files: Iterable[str]) -> list[str]:
    """A unique name for each mesh, valid in file names: letters, digits and underscores."""
    names: dict[str, str] = {}  # keys in lower case, as some file systems ignore case
    for file in files:
        plain = re.sub(r"\W+", "_", str(Path(file).with_suffix(""))).strip("_")[-80:] or "mesh"
        name, number = plain, 1
        while name.lower() in names:
            number += 1
            name = f"{plain}_{number}"
        names[name.lower()] = name
    return list(names.values())


def check(mesh: RawMesh) -> RawMesh:
    """The mesh without unused vertices, as float64 and int64. Raises ValueError if it cannot be rendered."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    numbers = vertices.dtype.kind in "fiu" and faces.dtype.kind in "iu"
    if not numbers or vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        shapes = f"{vertices.dtype} {list(vertices.shape)}, {faces.dtype} {list(faces.shape)}"
        raise ValueError(f"not a triangle mesh: wanted vertices float [V, 3] and faces int [F, 3], got {shapes}")
    if not 0 < len(faces) <= MAX_FACES:
        raise ValueError(f"too large: {len(faces)} faces, the limit is {MAX_FACES}" if len(faces) else "no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces refer to vertices {faces.min()} .. {faces.max()}, but there are {len(vertices)}")
    used, faces = np.unique(faces, return_inverse=True)
    vertices = vertices[used].astype(np.float64)
    extent = np.ptp(vertices, axis=0).max()
    if not 1e-12 < extent < 1e30:
        raise ValueError(f"no usable extent: its longest side is {extent:g}")
    return RawMesh(vertices, faces.reshape(-1, 3).astype(np.int64))


def fit_to_box(vertices: np.ndarray) -> np.ndarray:
    """Vertices [V, 3], moved and scaled so that their bounding box is centred at 0 and its longest side is 1."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return (vertices - (low + high) / 2) / (high - low).max()
