"""Reads untrusted meshes, voxel grids and pretrained weights in the sandbox."""

import io
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from learn3d.files import limits, sandbox
from learn3d.files.reading import DamagedFile, open_file, read_bytes

EXTENSIONS = (".obj", ".off", ".ply", ".stl", ".glb", ".gltf")  # trimesh reads these without further packages


@dataclass(frozen=True, eq=False)
class RawMesh:
    """The triangles of a file: right-handed coordinates of any scale and position, either winding."""

    vertices: np.ndarray  # float64 [V, 3]
    faces: np.ndarray  # int64 [F, 3]


def read_mesh(path: Path) -> RawMesh:
    """Read all triangles of a mesh file; the meshes of a scene are transformed and concatenated.

    Other files that it refers to must be in its folder or below. Raises MissingFile, and DamagedFile if it cannot be
    read, has no triangle, or has over 256 MiB.
    """
    return sandbox.read(_read, path, wanted="a mesh file")


def _read(path: Path) -> RawMesh:
    import trimesh

    content, kind = io.BytesIO(_content(path)), path.suffix.lower().lstrip(".")
    how = {"force": "scene", "process": False, "skip_materials": True}
    scene = trimesh.load(content, file_type=kind, resolver=_FilesBelow(path.parent), **how)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise DamagedFile(path, "no faces")
    vertices, faces = trimesh.util.append_faces([part.vertices for part in parts], [part.faces for part in parts])
    return RawMesh(np.asarray(vertices, np.float64), np.asarray(faces, np.int64))


class _FilesBelow:
    """A resolver for trimesh that reads files in a folder or below it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()

    def get(self, name: str) -> bytes:
        path = (self.folder / str(name).strip()).resolve()
        if not path.is_relative_to(self.folder):
            raise ValueError(f"it refers to {name!r}, which is outside of {self.folder}")
        return _content(path)

    __getitem__ = get


def _content(path: Path) -> bytes:
    """The content of a file; of an OBJ or OFF file as valid UTF-8, since comments may be in Latin-1."""
    content = read_bytes(path, limits.MESH_FILE_BYTES, "a mesh file, or a file that a mesh refers to")
    sandbox.allow(30 * len(content), len(content) / 1e6)  # for text, trimesh takes two thirds of that
    is_text = path.suffix.lower() in (".obj", ".off")
    return content.decode("utf-8", "replace").encode() if is_text else content


def read_matlab(path: Path, name: str, size: int) -> np.ndarray:
    """Which numbers of the array `name` [size, size, size] of a MATLAB file (version 5 to 7) are not 0: bool."""
    import scipy.io  # imported here, as its import takes longer than a worker's start

    wanted = f"a MATLAB file (version 5 to 7) with the array {name!r} of numbers [{size}, {size}, {size}]"
    with open_file(path, limits.VOLUME_BYTES, wanted) as file:
        array = np.asarray(scipy.io.loadmat(file, variable_names=[name]).get(name))
    if array.dtype.kind not in "biuf" or array.shape != (size,) * 3:
        raise DamagedFile(path, f"has {array.dtype} {list(array.shape)} as {name!r}; expected {wanted}")
    return array != 0


def read_state_dict(path: Path) -> dict[str, np.ndarray]:
    """Read the tensors of a state dict (.safetensors or from torch.save); half precision becomes float32.

    No code in the file is executed (weights_only). Raises DamagedFile if it is not a state dict.
    """
    with open_file(path, limits.WEIGHTS_BYTES, "weights of ResNet-18") as file:
        sandbox.allow(3 * 2**28 + 4 * os.fstat(file.fileno()).st_size, 25.0)  # most of it for importing torch
    import torch
    from safetensors.torch import load_file

    is_torch = path.suffix != ".safetensors"
    weights = torch.load(path, map_location="cpu", weights_only=True) if is_torch else load_file(path)
    if not isinstance(weights, dict) or not all(isinstance(value, torch.Tensor) for value in weights.values()):
        raise DamagedFile(path, f"must hold a state dict (names -> tensors), got {type(weights).__name__}")
    halves = (torch.float16, torch.bfloat16)
    return {str(n): (t.float() if t.dtype in halves else t).detach().numpy() for n, t in weights.items()}
