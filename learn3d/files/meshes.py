"""Untrusted mesh files: all triangles and their colours, read by trimesh in the sandbox."""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from learn3d.files import limits, sandbox
from learn3d.files.findings import DamagedFile, MissingFile
from learn3d.files.images import open_texture
from learn3d.files.reading import read_bytes

EXTENSIONS = (".obj", ".off", ".ply", ".stl", ".glb", ".gltf")  # what trimesh reads without further packages
_MEMORY_PER_BYTE = 30  # trimesh takes some 20 times the size of a text file
_BYTES_PER_SECOND = 1e6  # trimesh reads twice as many


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Triangles as read: any scale and place, right-handed, either winding."""

    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]
    face_colors: np.ndarray | None = None  # float32 [F, 3], RGB in [0, 1]; NaN or None if the file gives none


def read_mesh(path: Path, root: Path | None = None) -> RawMesh:
    """All triangles of a mesh file, scenes concatenated with their transforms, with their colours if it has any.

    root: the folder out of which files that it refers to (materials, textures, buffers) are read; None: its own.
    Raises ValueError with the reason if it cannot be read, holds no triangle, or has over 256 MiB.
    """
    try:
        return sandbox.read(_read, path, path.parent if root is None else root, wanted="a mesh file")
    except (DamagedFile, MissingFile) as error:
        raise ValueError(error.message) from error


def _read(path: Path, root: Path) -> RawMesh:
    """The mesh, in the sandbox."""
    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    Image.open = open_texture
    content, kind = io.BytesIO(_content(path)), path.suffix.lower().lstrip(".")
    beside = _FilesBelow(root.resolve(), path.parent)
    scene = trimesh.load(content, file_type=kind, resolver=beside, force="scene", process=False)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise DamagedFile(path, "no faces")
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return RawMesh(
        vertices=np.concatenate([np.asarray(part.vertices, np.float64) for part in parts]),
        faces=np.concatenate([np.asarray(p.faces, np.int64) + o for p, o in zip(parts, offsets, strict=True)]),
        face_colors=np.concatenate([_part_colors(part) for part in parts]),
    )


class _FilesBelow:
    """A resolver for trimesh: the files that a mesh in `folder` refers to, none from outside of `root`."""

    def __init__(self, root: Path, folder: Path) -> None:
        self.root, self.folder = root, folder

    def get(self, name: str) -> bytes:
        path = (self.folder / str(name).strip()).resolve()
        if not path.is_relative_to(self.root):
            raise ValueError(f"it refers to {name!r}, which is outside of {self.root}")
        return _content(path)

    __getitem__ = get

    def namespaced(self, namespace: str) -> _FilesBelow:
        return _FilesBelow(self.root, self.folder / namespace)

    def keys(self) -> list[str]:
        return []


def _content(path: Path) -> bytes:
    """A file; a text, also that at the head of a PLY file, in UTF-8: comments and names may be in Latin-1."""
    content = read_bytes(path, limits.MESH_FILE_BYTES, "a mesh file, or a file that a mesh refers to")
    sandbox.allow(_MEMORY_PER_BYTE * len(content), len(content) / _BYTES_PER_SECOND)
    suffix = path.suffix.lower()
    is_text = suffix in (".obj", ".off", ".mtl")
    if suffix == ".stl":  # a binary one has 50 bytes for each of as many triangles as its header says
        is_text = len(content) != 84 + 50 * int.from_bytes(content[80:84], "little")
    end = content.find(b"end_header") + 1 if suffix == ".ply" else len(content) * is_text
    try:
        content[:end].decode()
        return content
    except UnicodeDecodeError:
        return content[:end].decode("latin-1").encode() + content[end:]


def _part_colors(part: Any) -> np.ndarray:
    """Face colours float32 [F, 3] of a trimesh.Trimesh; a texture is sampled at the vertices. NaN if it has none."""
    none = np.full((len(part.faces), 3), np.nan, dtype=np.float32)
    visual = part.visual
    if visual is None or not visual.defined:
        return none
    try:
        if visual.kind == "texture":  # sampled, it does not know its mesh
            colors = np.asarray(visual.to_color().vertex_colors, dtype=np.float64)
            if colors.ndim == 1:  # without an image: the material's one colour
                colors = np.broadcast_to(colors, (len(part.vertices), len(colors)))
            colors = colors[part.faces].mean(axis=1)
        else:
            colors = np.asarray(visual.face_colors)
    except Exception:  # a texture that cannot be read must not cost the mesh
        return none
    return (colors[:, :3] / 255).astype(np.float32) if len(colors) == len(none) else none
