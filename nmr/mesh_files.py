"""Mesh files: OBJ and glTF with their materials."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ._images import write_png
from ._validate import _FLOATS, _INTEGERS, check_indices, describe
from .gltf import read_gltf
from .materials import Materials
from .obj import find_image, find_libraries, load, match_materials, read_mtl
from .textures import NormalMap, UVTexture, VertexColors

__all__ = ["load_gltf", "load_obj", "save_obj"]


class Material(NamedTuple):
    """A material of a mesh file."""

    name: str
    color: tuple[float, float, float] | None  # MTL's `Kd`, glTF's factor of the base colour
    # path of the image (MTL's `map_Kd`); of a glTF file the image itself, encoded
    image: str | bytes | None
    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)  # the image is multiplied by it


class MeshFile(NamedTuple):
    """A mesh with its materials, as :func:`load_obj` and :func:`load_gltf` return it."""

    vertices: Tensor  # [V, 3]
    faces: Tensor  # int64 [F, 3]
    uv: Tensor  # [T, 2]
    uv_faces: Tensor  # int64 [F, 3], -1 at faces without texture coordinates
    face_material: Tensor  # int64 [F], index in `materials`; -1 without a material
    materials: tuple[Material, ...]
    colors: Tensor | None  # [V, 3] in [0, 1]


def load_obj(filename: str | os.PathLike, dtype: torch.dtype = torch.float32) -> MeshFile:
    """Read a Wavefront OBJ file.

    Polygons are cut into triangles; concave ones keep their outline. Groups, points, lines and
    normals are skipped, and so are the texture coordinates of a face that has them at some corners
    only.

    Parameters
    ----------
    filename : str or path
    dtype : torch.float32 or torch.float64
        Of the floating-point tensors. For coordinates as large as UTM's take float64, subtract the
        middle, then call ``.float()``.

    Returns
    -------
    MeshFile
        A named tuple of tensors on the default device. ``faces[f]`` and ``uv_faces[f]`` are the
        rows of ``vertices [V, 3]`` and ``uv [T, 2]`` at the corners of face f; (0, 0) of ``uv`` is
        the lower left corner of an image. ``materials[face_material[f]]`` has name, colour and
        image path of its material, for :meth:`Materials.from_mesh`. ``colors [V, 3]`` are those of
        the lines ``v x y z r g b``, None if there are none; vertices without are grey (0.5). They
        count as 0..255 if one is above 2, or if all are whole numbers and one is above 1, and are
        clipped to [0, 1].

    Raises
    ------
    FileNotFoundError
        If the file is missing. A missing MTL file and unknown materials are warnings.
    ValueError
        If there are no vertices or no faces, or a line, which is numbered, cannot be read or refers
        to a missing element.

    Examples
    --------
    >>> mesh, camera = nmr.load_obj("chair.obj"), nmr.LookAt.from_angles(2.732, 30.0, 45.0)
    >>> rgb = nmr.render_rgb(mesh.vertices, mesh.faces, camera, colors=nmr.Materials.from_mesh(mesh))
    """
    filename = os.fspath(filename)
    vertices, colors, uv, faces, uv_faces, face_material, names, libraries = load(filename)
    materials, folder = {}, os.path.dirname(filename)
    for library in find_libraries(folder, libraries):
        if not os.path.isfile(library):
            warnings.warn(
                f"{filename} names the materials {library}, which is missing", stacklevel=2
            )
            continue
        kd, map_kd = read_mtl(library)
        for name in {**kd, **map_kd}:
            image = find_image(folder, map_kd[name]) if name in map_kd else None
            materials[name] = Material(
                name, tuple(kd[name].tolist()) if name in kd else None, image
            )
    numbers = {name: number for number, name in enumerate(materials)}
    matched = (
        match_materials(names, face_material, materials, filename)
        if libraries
        else [""] * len(names)
    )
    face_material = torch.tensor([numbers.get(name, -1) for name in matched])[
        torch.from_numpy(face_material)
    ]
    if colors is not None:
        colors = np.where(np.isfinite(colors).all(axis=1, keepdims=True), colors, np.nan)
        largest, known = np.nanmax(colors, initial=0), colors[np.isfinite(colors)]
        in_bytes = largest > 2 or (largest > 1 and (known == known.round()).all())
        colors = np.nan_to_num(colors / (255 if in_bytes else 1), nan=0.5).clip(0, 1)
        colors = torch.tensor(colors, dtype=dtype)
    # Each array is freed as soon as its tensor exists.
    vertices, uv = torch.tensor(vertices, dtype=dtype), torch.tensor(uv, dtype=dtype)
    faces = torch.tensor(faces, dtype=torch.int64)
    uv_faces = torch.tensor(uv_faces, dtype=torch.int64)
    return MeshFile(vertices, faces, uv, uv_faces, face_material, tuple(materials.values()), colors)


def load_gltf(filename: str | os.PathLike, dtype: torch.dtype = torch.float32) -> MeshFile:
    """Read a glTF 2.0 file, .glb or .gltf: the meshes of its default scene, as one.

    They are at their places in the scene, not animated. Points, lines, normals and all of a
    material but its base colour are skipped.

    Parameters
    ----------
    filename : str or path
    dtype : torch.float32 or torch.float64
        Of the floating-point tensors.

    Returns
    -------
    MeshFile
        As of :func:`load_obj`, with images of the base colour; ``colors`` are white at vertices
        without, None if there are none.

    Raises
    ------
    FileNotFoundError
        If the file, or one that it refers to, is missing.
    ValueError
        If it has no faces, cannot be read, needs an unsupported extension, or refers to a file
        outside of its folder.

    Examples
    --------
    >>> mesh, camera = nmr.load_gltf("chair.glb"), nmr.LookAt.from_angles(2.732, 30.0, 45.0, right_handed=True)
    >>> rgb = nmr.render_rgb(mesh.vertices, mesh.faces, camera, colors=nmr.Materials.from_mesh(mesh))
    """
    filename = Path(filename)

    def read_other(name: str) -> bytes:
        path = (filename.parent / name).resolve()
        if not path.is_relative_to(filename.parent.resolve()):
            raise ValueError(f"it refers to {name!r}, which is outside of its folder")
        return path.read_bytes()

    if filename.exists() and not filename.is_file():
        raise ValueError(f"{filename} is not a regular file")
    content = filename.read_bytes()
    try:
        gltf = read_gltf(content, read_other, with_materials=True)
    except FileNotFoundError:
        raise
    except (ValueError, EOFError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(f"{filename} cannot be read: {error!r}") from error
    if not len(gltf.faces):
        raise ValueError(f"{filename} has no faces")
    faces = torch.tensor(gltf.faces)
    has_uv = np.isfinite(gltf.uv).all(axis=1)[gltf.faces].all(axis=1)
    colors = None
    if not np.isnan(gltf.colors).all():
        colors = torch.tensor(np.nan_to_num(gltf.colors, nan=1.0), dtype=dtype)
    return MeshFile(
        torch.tensor(gltf.vertices, dtype=dtype),
        faces,
        torch.tensor(np.nan_to_num(gltf.uv), dtype=dtype),
        torch.where(torch.tensor(has_uv)[:, None], faces, -1),
        torch.tensor(gltf.face_material),
        tuple(Material(x.name, x.factor, x.image, x.factor) for x in gltf.materials),
        colors,
    )


def save_obj(
    filename: str | os.PathLike,
    vertices: Tensor,
    faces: Tensor,
    colors: VertexColors | UVTexture | Materials | None = None,
) -> None:
    """Write a mesh as a Wavefront OBJ file; images and materials in files beside it.

    Parameters
    ----------
    filename : str or path
        Ends in .obj. Materials are in ``name.mtl``, images in ``name.png``, or ``name_1.png`` and
        so on.
    vertices : float32 or float64 Tensor [V, 3]
        :func:`load_obj` gives the same values.
    faces : integer Tensor [F, 3]
    colors : VertexColors, UVTexture or Materials of this mesh, optional
        In [0, 1], or clamped. Images have 8 bits, and need Pillow.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, numbers that are not finite, faces of missing vertices, several
        meshes, another ending; nothing is written. A texture whose ``wrap`` is not "repeat" is a
        warning, as the file cannot store it.
    ImportError
        If there are images and Pillow is missing.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(2)
    >>> nmr.save_obj("earth.obj", vertices, faces, nmr.UVTexture(torch.rand(8, 16, 3), 0.5 + vertices[:, :2] / 2))
    >>> len(nmr.load_obj("earth.obj").uv)
    162
    """
    base, ending = os.path.splitext(os.fspath(filename))
    if ending.lower() != ".obj":
        raise ValueError(f"filename must end in .obj, got {os.fspath(filename)!r}")
    corners = _rows(faces, "faces", 3, integers=True) + 1
    points = _rows(vertices, "vertices", 3)
    check_indices(corners - 1, len(points))
    accepted = isinstance(colors, (VertexColors, UVTexture, Materials))
    if colors is not None and (not accepted or isinstance(colors, NormalMap)):
        raise TypeError(
            f"colors must be nmr.VertexColors, UVTexture or Materials, got {describe(colors)}"
        )
    name = "colors" if isinstance(colors, VertexColors) else "vertex_colors"
    of_vertices = getattr(colors, name, None)
    if of_vertices is not None:
        shades = _rows(of_vertices, name, 3).clamp(0, 1)
        if len(shades) != len(points):
            raise ValueError(f"{name} must be one per vertex, {len(points)}, got {len(shades)}")
        points = torch.cat([points, shades.to(points)], dim=1)
    lines = _lines("v", points)
    if isinstance(colors, (UVTexture, Materials)):
        lines += _material_lines(base, corners, colors)
    else:
        lines += ["f {} {} {}".format(*face) for face in corners.tolist()]
    _write_text(f"{base}{ending}", lines)


def _material_lines(base: str, corners: Tensor, colors: UVTexture | Materials) -> list[str]:
    """Texture coordinates and faces; writes the materials and images."""
    name = os.path.basename(base)
    if isinstance(colors, UVTexture):
        images, shades, rows = [colors.image], None, colors.uv_faces
        rows = corners - 1 if rows is None else _rows(rows, "uv_faces", 3, integers=True)
        numbers = torch.zeros(len(corners), dtype=torch.int64, device="cpu")
    else:
        shades = F.pad(colors.colors.detach().cpu(), (0, 0, 0, 1), value=colors.without_material)
        images, rows = [*colors.images, None], colors.uv_faces
        numbers = _rows(colors.face_material.unsqueeze(1), "face_material", 1, integers=True)[:, 0]
        numbers = numbers % len(shades)  # -1 is the last one
        missing = torch.full_like(corners, -1)
        rows = missing if rows is None else _rows(rows, "uv_faces", 3, integers=True)
    if len(rows) != len(corners) or len(numbers) != len(corners):
        raise ValueError(f"colors must be those of {len(corners)} faces, got {len(rows)}")
    pictures = {k: _rows(x, "image", 3, 3) for k, x in enumerate(images) if x is not None}
    uv = torch.empty(0, 2, device="cpu") if colors.uv is None else _rows(colors.uv, "uv", 2)
    used = rows[rows.amin(1) >= 0]
    check_indices(used, len(uv), "uv_faces", "row", "uv", "rows")
    if colors.wrap != "repeat" and ((uv[used] < 0) | (uv[used] > 1)).any():
        warnings.warn(
            f"an OBJ file cannot store wrap={colors.wrap!r}: where uv is outside of [0, 1], readers repeat the image",
            stacklevel=3,
        )
    material_lines = []
    for k in sorted(set(numbers.tolist())):
        material_lines.append(f"newmtl material_{k + 1}")
        if shades is not None:
            material_lines += _lines("Kd", shades[k : k + 1].clamp(0, 1))
        if k in pictures:
            file = f"{name}.png" if len(pictures) == 1 else f"{name}_{k + 1}.png"
            write_png(os.path.join(os.path.dirname(base), file), pictures[k].float().numpy())
            material_lines.append(f"map_Kd {file}")
    _write_text(f"{base}.mtl", material_lines)
    lines, before = [f"mtllib {name}.mtl", *_lines("vt", uv)], -1
    for face, row, number in zip(corners.tolist(), rows.tolist(), numbers.tolist(), strict=True):
        if number != before:
            lines.append(f"usemtl material_{number + 1}")
        before = number
        at = face if min(row) < 0 else [f"{a}/{b + 1}" for a, b in zip(face, row, strict=True)]
        lines.append("f {} {} {}".format(*at))
    return lines


def _rows(values: object, name: str, columns: int, ndim: int = 2, integers: bool = False) -> Tensor:
    """Values of one mesh in host memory: finite floats, or integers as int64."""
    if not isinstance(values, Tensor) or values.ndim != ndim or values.shape[-1] != columns:
        wanted = ", ".join([*("N", "H, W")[ndim == 3 :][:1], str(columns)])
        raise ValueError(
            f"{name} must be those of one mesh, a tensor [{wanted}], got {describe(values)}; take [0]"
        )
    if values.dtype not in (_INTEGERS if integers else _FLOATS):
        kind = "integers" if integers else "float32 or float64"
        raise TypeError(f"{name} must be {kind}, got {describe(values)}")
    values = values.detach().cpu()
    if not values.isfinite().all():
        raise ValueError(f"{name} must be finite, but has values that are infinite or NaN")
    return values.long() if integers else values


def _lines(keyword: str, rows: Tensor) -> list[str]:
    """A line for each row, with the digits that give back its values."""
    digits = 9 if rows.dtype == torch.float32 else 17
    form = " ".join([keyword, *[f"{{:.{digits}g}}"] * rows.shape[1]])
    return [form.format(*row) for row in rows.tolist()]


def _write_text(filename: str, lines: Sequence[str]) -> None:
    partial = f"{filename}.part"
    with open(partial, "w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(lines) + "\n")
    os.replace(partial, filename)
