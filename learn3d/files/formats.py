"""Reads untrusted meshes, voxel grids, tables of numbers and pretrained weights in the sandbox."""

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.identity import measure
from learn3d.files.reading import DamagedFile, faults_of, open_file, read_bytes, read_text

EXTENSIONS = (".obj", ".off", ".ply", ".stl", ".glb", ".gltf")


@dataclass(frozen=True, eq=False)
class RawMesh:
    """The triangles of a file: right-handed coordinates of any scale and position, either
    winding.
    """

    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]


def read_mesh(path: Path) -> RawMesh:
    """Read all triangles of a mesh file; the meshes of a scene are transformed and concatenated.

    Polygons are cut into triangles, concave ones, too. Other files that it refers to must be in
    its folder or below. Raises MissingFile, and DamagedFile if it cannot be read as a whole, has
    no triangle or over 256 MiB, or if a corner is not finite, or if all are at one place.
    """
    mesh = sandbox.read(_read, path, wanted="a mesh file")
    return RawMesh(mesh.vertices, mesh.faces.astype(np.int64))


def measure_mesh(path: Path) -> np.ndarray:
    """The measures of a mesh file by which equal geometries are found. Runs in the sandbox."""
    mesh = _read(path)
    return measure(mesh.vertices, mesh.faces)


def _read(path: Path) -> RawMesh:
    with (
        open_file(path, limits.MESH_FILE_BYTES, "a mesh file") as file,
        faults_of(path, "a mesh file", advice=""),
    ):
        size = os.fstat(file.fileno()).st_size
        sandbox.allow(30 * size, size / 1e6)
        if not size:
            raise EOFError("it is empty")
        vertices, faces = _triangles(path, file)
        if not len(faces):
            raise DamagedFile(path, "no faces")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError(
                f"faces refer to vertices {faces.min()} .. {faces.max()}; there are {len(vertices)}"
            )
        is_used = np.zeros(len(vertices), bool)
        is_used[faces] = True
        used = vertices[is_used]
        if not np.isfinite(used).all():
            raise ValueError(
                f"{np.count_nonzero(~np.isfinite(used).all(axis=1))} of its corners are not finite"
            )
        if (used == used[0]).all():
            raise ValueError("all its corners are at one place: its longest side is 0")
    return RawMesh(np.asarray(vertices, np.float64), faces)


def _triangles(path: Path, file: BinaryIO) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3].

    Modules are imported here, so that a worker imports only those it needs.
    """
    kind = path.suffix.lower()
    if kind == ".obj":
        from nmr.obj import read_obj

        mesh = read_obj(file, with_uv=False)
        return mesh.vertices, mesh.faces
    if kind in (".glb", ".gltf"):
        from nmr.gltf import read_gltf

        mesh = read_gltf(file.read(), lambda name: _file_below(path.parent, name))
        return mesh.vertices, mesh.faces
    from learn3d.files.meshes import read_off, read_ply, read_stl

    return {".off": read_off, ".ply": read_ply, ".stl": read_stl}[kind](file.read())


def _file_below(folder: Path, name: str) -> bytes:
    """The content of a file in a folder or below it."""
    path = (folder / name.strip()).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise ValueError(f"it refers to {name!r}, which is outside of {folder.resolve()}")
    content = read_bytes(path, limits.MESH_FILE_BYTES, "a file that a mesh refers to")
    sandbox.allow(30 * len(content), len(content) / 1e6)
    return content


def read_matlab(path: Path, name: str, size: int) -> np.ndarray:
    """Which numbers of the array `name` [size, size, size] of a MATLAB file are not 0: bool."""
    import scipy.io  # imported here, as its import takes longer than a worker's start

    wanted = f"a MATLAB file (version 5 to 7) with the array {name!r} of numbers [{size}, {size}, {size}]"
    with open_file(path, limits.VOLUME_BYTES, wanted) as file:
        array = np.asarray(scipy.io.loadmat(file, variable_names=[name]).get(name))
    if array.dtype.kind not in "biuf" or array.shape != (size,) * 3:
        raise DamagedFile(
            path, f"has {array.dtype} {list(array.shape)} as {name!r}; expected {wanted}"
        )
    return array != 0


def read_table(path: Path, rows: int, columns: int, wanted: str) -> np.ndarray:
    """The first rows and columns of a table in a text file: float64 [rows, columns], finite."""
    text = io.StringIO(read_text(path, limits.TEXT_BYTES, wanted))
    table = np.loadtxt(text, comments=None, usecols=range(columns), max_rows=rows, ndmin=2)
    if (found := np.isfinite(table).all(axis=1).sum()) < rows:
        raise ValueError(f"{found} rows of finite numbers, {rows} are needed")
    return table


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Read the tensors of a state dict (.safetensors or from torch.save); half precision becomes
    float32.

    No code in the file is executed (weights_only). Raises DamagedFile if it is not a state dict.
    """
    with open_file(path, limits.WEIGHTS_BYTES, "weights of ResNet-18") as file:
        # most of it for importing torch
        sandbox.allow(3 * 2**28 + 4 * os.fstat(file.fileno()).st_size, 25.0)
    import torch
    from safetensors.torch import load_file

    is_torch = path.suffix != ".safetensors"
    weights = (
        torch.load(path, map_location="cpu", weights_only=True) if is_torch else load_file(path)
    )
    if not isinstance(weights, dict) or not all(
        isinstance(value, torch.Tensor) for value in weights.values()
    ):
        raise DamagedFile(
            path, f"must hold a state dict (names -> tensors), got {type(weights).__name__}"
        )
    halves = (torch.float16, torch.bfloat16)
    return {
        str(n): (t.float() if t.dtype in halves else t).detach().numpy() for n, t in weights.items()
    }
