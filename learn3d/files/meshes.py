"""Untrusted mesh files: all triangles, read by trimesh in the sandbox."""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.findings import DamagedFile, MissingFile
from learn3d.files.reading import read_bytes

EXTENSIONS = (".obj", ".off", ".ply", ".stl", ".glb", ".gltf")  # trimesh reads these without further packages
_MEMORY_PER_BYTE = 30  # trimesh takes some 20 times the size of a text file
_BYTES_PER_SECOND = 1e6  # trimesh reads twice as many


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Triangles as read: any scale and place, right-handed, either winding."""

    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]


def read_mesh(path: Path) -> RawMesh:
    """All triangles of a mesh file, scenes concatenated with their transforms.

    Buffers that it refers to must lie in its own folder or below. Raises ValueError with the reason if it cannot be
    read, holds no triangle, or has over 256 MiB.
    """
    try:
        return sandbox.read(_read, path, wanted="a mesh file")
    except (DamagedFile, MissingFile) as error:
        raise ValueError(error.message) from error


def _read(path: Path) -> RawMesh:
    """The mesh, in the sandbox."""
    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    content, kind = io.BytesIO(_content(path)), path.suffix.lower().lstrip(".")
    how = {"force": "scene", "process": False, "skip_materials": True}
    scene = trimesh.load(content, file_type=kind, resolver=_FilesBelow(path.parent), **how)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise DamagedFile(path, "no faces")
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return RawMesh(
        vertices=np.concatenate([np.asarray(part.vertices, np.float64) for part in parts]),
        faces=np.concatenate([np.asarray(p.faces, np.int64) + o for p, o in zip(parts, offsets, strict=True)]),
    )


class _FilesBelow:
    """A resolver for trimesh: files in a folder or below."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()

    def get(self, name: str) -> bytes:
        path = (self.folder / str(name).strip()).resolve()
        if not path.is_relative_to(self.folder):
            raise ValueError(f"it refers to {name!r}, which is outside of {self.folder}")
        return _content(path)

    __getitem__ = get


def _content(path: Path) -> bytes:
    """A file; an OBJ or OFF file in UTF-8: comments and names may be in Latin-1."""
    content = read_bytes(path, limits.MESH_FILE_BYTES, "a mesh file, or a file that a mesh refers to")
    sandbox.allow(_MEMORY_PER_BYTE * len(content), len(content) / _BYTES_PER_SECOND)
    is_text = path.suffix.lower() in (".obj", ".off")
    return content.decode("utf-8", "replace").encode() if is_text else content
