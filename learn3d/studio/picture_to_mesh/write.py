"""Writes reconstructions: mesh files, turntables, and strips of views."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import torch
import trimesh

from learn3d.data.conventions import mesh_to_object
from learn3d.data.layouts import LAYOUTS, Layout
from learn3d.files import writing
from learn3d.pictures import (
    PROGRAM,
    Surface,
    draw_around,
    natural_colors,
    save_gif,
    save_png,
    tile,
    turntable,
)
from learn3d.studio.picture_to_mesh.fit import View

MeshFormat: TypeAlias = Literal["glb", "obj", "ply"]

STRIP_SIZE = 192  # side of each picture in a strip, in pixels
_HEADER_BYTES = 2**16  # part of a file that names the program


class Reconstruction(NamedTuple):
    """The shape of a picture, and how it was found."""

    surface: Surface  # object frame; with the picture's colours if it was fitted
    stored: np.ndarray  # uint8 [4, S, S]: the input of the network
    azimuth_deg: float  # estimated azimuth of the picture's camera
    # IoU of the fitted shape's silhouette and the mask; None without a fit
    silhouette_iou: float | None = None
    # predicted category; None without a fit, or without templates if the model has only one
    kind: str | None = None
    warning: str | None = None  # a reason to doubt the shape; None without a fit
    view: View | None = None  # the picture's camera; None without a fit


def export_mesh(path: Path, surface: Surface) -> None:
    """Write a mesh of the object frame as OBJ, GLB or PLY (by the file's ending): see `mesh_bytes`."""
    writing.write_bytes(path, mesh_bytes(surface, path.suffix.lower().lstrip("."), path.stem))


def mesh_bytes(surface: Surface, kind: str, name: str) -> bytes:
    """A file of the kind "obj", "glb" or "ply" with a mesh of the object frame, y up, right-handed.

    The object frame is left-handed, so the mesh is reflected and the order of each face reversed.
    All formats share vertices between faces, and have smooth normals (outwards) and the colours
    at the vertices. `name` is the mesh's in a GLB, whose material is double-sided: learnt surfaces
    cross themselves, and viewers would hide the faces that are seen from behind.
    """
    points = surface.vertices.detach().cpu().double().numpy() @ mesh_to_object()
    mesh = trimesh.Trimesh(points, surface.faces.cpu().numpy()[:, ::-1], process=False)
    if len(points):
        normals = np.array(mesh.vertex_normals)
        normals[~normals.any(axis=1)] = (0, 1, 0)  # at vertices whose faces have no area
        mesh.vertex_normals = normals
    if surface.colors is not None:
        colors = surface.colors.detach().cpu().clamp(0, 1)
        colors = colors**2.2 if kind == "glb" else colors  # colours of vertices in a GLB are linear
        mesh.visual.vertex_colors = (colors * 255).round().to(torch.uint8).numpy()
    if kind == "glb":
        return trimesh.Scene({name: mesh}).export(
            file_type=kind, include_normals=True, tree_postprocessor=_finish
        )
    if kind == "obj":
        return mesh.export(file_type=kind, include_normals=True, header=PROGRAM).encode()
    content = mesh.export(file_type=kind, vertex_normal=True)
    return re.sub(b"comment .*", f"comment {PROGRAM}".encode(), content, count=1)


def _finish(tree: dict) -> None:
    """Give the meshes of a glTF tree a matt, double-sided material, and name the program."""
    tree["asset"]["generator"] = PROGRAM
    matt = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    for mesh in tree.get("meshes", ()):  # an empty shape has none, any other one
        tree["materials"] = [{"pbrMetallicRoughness": matt, "doubleSided": True}]
        (primitive,) = mesh["primitives"]
        primitive["material"] = 0
        views = tree["bufferViews"]
        for view in views:
            view["target"] = 34962  # glTF's number for vertices
        indices = tree["accessors"][primitive["indices"]]
        views[indices["bufferView"]]["target"] = 34963  # and for their numbers


def _paths(folder: Path, name: str, mesh_format: MeshFormat) -> tuple[Path, Path, Path]:
    """The mesh, the turntable and the strip of a shape."""
    return tuple(folder / f"{name}.{suffix}" for suffix in (mesh_format, "gif", "png"))


def check_replaced(folder: Path, names: Sequence[str], mesh_format: MeshFormat) -> None:
    """Raise ValueError if `save` would replace a file that this program has not written."""
    for path in (path for name in names for path in _paths(folder, name, mesh_format)):
        if path.is_file():
            with path.open("rb") as file:
                if PROGRAM.encode() not in file.read(_HEADER_BYTES):
                    raise ValueError(
                        f"{path} would be replaced, and is no file of {PROGRAM}; give another --output"
                    )


def save(
    folder: Path,
    names: Sequence[str],
    made: Sequence[Reconstruction],
    layout: Layout,
    mesh_format: MeshFormat,
) -> list[Path]:
    """Write <name>.<format>, <name>.gif (turntable) and <name>.png (input, mask, six views) of each shape.

    layout: of their input. Returns three paths for each name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    turns = [60 * k for k in range(6)]
    titles = ["input", "mask", "from the input's side", *(f"turned by {k}°" for k in turns[1:])]
    paths = []
    for name, (surface, stored, azimuth_deg, *_) in zip(names, made, strict=True):
        mesh, animation, strip = _paths(folder, name, mesh_format)
        export_mesh(mesh, surface)
        save_gif(animation, turntable(surface))
        colors = natural_colors(stored, inverted=LAYOUTS[layout].inverted)
        azimuths = [azimuth_deg - turn for turn in turns]
        views = draw_around(surface, azimuths, image_size=STRIP_SIZE)
        shown = [colors, np.repeat(stored[3][..., None], 3, axis=2), *views]
        save_png(strip, tile([shown], titles, tile_size=STRIP_SIZE))
        paths += [mesh, animation, strip]
    return paths
