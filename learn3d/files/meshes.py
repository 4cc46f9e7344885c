"""Mesh files that somebody else may have made: all triangles and their colours, read by trimesh in a worker process."""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.findings import DamagedFile, MissingFile
from learn3d.files.images import opening_only
from learn3d.files.reading import read_bytes

EXTENSIONS = (".obj", ".off", ".ply", ".stl", ".glb", ".gltf")  # what trimesh reads without further packages
TEXTURES = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "TGA", "GIF", "PPM", "DDS")
_TEXT = (".obj", ".off", ".mtl")
_MEMORY_PER_BYTE = 30  # trimesh takes some 20 times the size of a text file
_BYTES_PER_SECOND = 2e6  # a text file of 100 MB takes 20 seconds


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Triangles as read: any scale and place, right-handed, either winding."""

    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]
    face_colors: np.ndarray | None = None  # float32 [F, 3], RGB in [0, 1], NaN or None where the file gives none


def read_mesh(path: Path, root: Path | None = None) -> RawMesh:
    """All triangles of a mesh file, scenes concatenated with their transforms, with their colours where it has any.

    root: the folder out of which files that it refers to (materials, textures, buffers) are read; None: its own.
    Raises ValueError with the reason where it cannot be read, holds no triangle, or has over 256 MiB.
    """
    try:
        return sandbox.read(_read, path, path.parent if root is None else root, wanted="a mesh file")
    except (DamagedFile, MissingFile) as error:
        raise ValueError(error.message) from error


def _read(path: Path, root: Path) -> RawMesh:
    """In a worker: the mesh; what trimesh raises is put into words there."""
    import trimesh

    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    content = _as_utf8(read_bytes(path, limits.MESH_FILE_BYTES, "a mesh file"), path.suffix)
    sandbox.allow(_MEMORY_PER_BYTE * len(content), len(content) / _BYTES_PER_SECOND)
    kind, beside = path.suffix.lower().lstrip("."), _files_below(path.parent, root.resolve())
    with opening_only(TEXTURES):
        scene = trimesh.load(io.BytesIO(content), file_type=kind, resolver=beside, force="scene", process=False)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise DamagedFile(path, "no faces")
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return RawMesh(
        vertices=np.concatenate([np.asarray(part.vertices, np.float64) for part in parts]),
        faces=np.concatenate([np.asarray(p.faces, np.int64) + o for p, o in zip(parts, offsets, strict=True)]),
        face_colors=np.concatenate([_part_colors(part) for part in parts]),
    )


def _as_utf8(content: bytes, suffix: str) -> bytes:
    """A text file, or the text at the head of a PLY file, in UTF-8: comments and names may be in Latin-1."""
    end = len(content) if suffix.lower() in _TEXT else 0
    if suffix.lower() == ".ply":
        end = max(0, content.find(b"end_header"))
    elif suffix.lower() == ".stl" and content.startswith(b"solid"):
        end = content.find(b"\n") if b"facet" in content[:1000] else 0
    try:
        content[:end].decode()
        return content
    except UnicodeDecodeError:
        return content[:end].decode("latin-1").encode() + content[end:]


def _files_below(folder: Path, root: Path) -> Any:
    """A trimesh resolver of names in `folder`, which gives nothing out that lies outside of `root`."""
    from trimesh.resolvers import Resolver

    class Below(Resolver):
        def __init__(self) -> None:
            """There is nothing to keep."""

        def get(self, name: str) -> bytes:
            path = (folder / str(name).strip()).resolve()
            if not path.is_relative_to(root):
                raise ValueError(f"it refers to {name!r}, which lies outside of {root}")
            content = read_bytes(path, limits.MESH_FILE_BYTES, "a file that a mesh refers to")
            sandbox.allow(_MEMORY_PER_BYTE * len(content))
            return _as_utf8(content, path.suffix)

        def namespaced(self, namespace: str) -> Resolver:
            return _files_below(folder / namespace, root)

        def keys(self) -> list[str]:
            return []

        def write(self, name: str, data: bytes) -> None:
            raise ValueError("a mesh that is read writes nothing")

    return Below()


def _part_colors(part: Any) -> np.ndarray:
    """Face colours float32 [F, 3] of a trimesh.Trimesh; a texture is sampled at the vertices. NaN where it has none."""
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
