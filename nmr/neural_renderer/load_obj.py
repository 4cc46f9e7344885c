"""Wavefront .obj files, with their materials baked into texture cubes."""

from __future__ import annotations

import os
import re
from array import array
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ._images import read_image

WRAPPINGS = ("REPEAT", "MIRRORED_REPEAT", "CLAMP_TO_EDGE", "CLAMP_TO_BORDER")
_GREY = 0.5  # colour of faces without a material
_LARGEST = float(np.finfo(np.float32).max)
_MOST_BYTES = 2**30  # of an .obj or .mtl file; reading one takes some 30 times its size


@dataclass
class _Obj:
    """The lines of an .obj file that matter; polygons are fans of triangles, numbers count from 0."""

    vertices: array = field(default_factory=lambda: array("d"))  # x, y, z of each
    uv: array = field(default_factory=lambda: array("d"))  # u, v of each
    faces: array = field(default_factory=lambda: array("i"))  # v0, v1, v2 of each
    uv_faces: array = field(default_factory=lambda: array("i"))  # vt0, vt1, vt2, or -1, -1, -1 without coordinates
    materials: list = field(default_factory=lambda: [("", 0)])  # (name, the face that it begins with)
    libraries: list = field(default_factory=list)  # names of .mtl files


def load_obj(
    filename_obj: str | os.PathLike,
    normalization: bool = True,
    texture_size: int = 4,
    load_texture: bool = False,
    texture_wrapping: str = "REPEAT",
    use_bilinear: bool = True,
) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor]:
    """Read a mesh; polygons become fans of triangles.

    Parameters
    ----------
    filename_obj : str or path
    normalization : bool
        Move and scale the mesh so that its box is centred on the origin with longest side 2.
    texture_size : int
        ts, texels along each axis of a texture cube.
    load_texture : bool
        Also read the materials (``Kd``, ``map_Kd``) and their images. Images need Pillow.
    texture_wrapping : {"REPEAT", "MIRRORED_REPEAT", "CLAMP_TO_EDGE", "CLAMP_TO_BORDER"}
        What texture coordinates outside [0, 1] mean: see :func:`bake_textures`.
    use_bilinear : bool
        Blend the four nearest pixels of the image; otherwise take the nearest.

    Returns
    -------
    vertices : float32 Tensor [V, 3]
    faces : int32 Tensor [F, 3]
    textures : float32 Tensor [F, ts, ts, ts, 3]
        Only with ``load_texture``: the image where a material has one, else its colour ``Kd``, else grey.

    Raises
    ------
    ValueError
        For a file without vertices or faces, for a line that cannot be read or that refers to missing elements (the
        message gives file and line), for another wrapping, and with ``load_texture`` for a file that names no .mtl.
    FileNotFoundError
        For a missing .obj, .mtl or image.
    ImportError
        If an image is wanted and Pillow is missing.

    >>> vertices, faces, textures = nr.load_obj("chair.obj", texture_size=8, load_texture=True)
    """
    filename_obj = os.fspath(filename_obj)
    if texture_wrapping not in WRAPPINGS:
        raise ValueError(f"texture_wrapping must be one of {', '.join(WRAPPINGS)}, got {texture_wrapping!r}")
    obj = _read_obj(filename_obj)
    vertices = torch.from_numpy(np.array(obj.vertices, np.float32).reshape(-1, 3))
    faces = torch.from_numpy(np.array(obj.faces, np.int32).reshape(-1, 3))
    if normalization:
        vertices = vertices - vertices.amin(0)
        vertices = vertices / vertices.abs().max() * 2
        vertices = vertices - vertices.amax(0) / 2
    if not vertices.isfinite().all():
        raise ValueError(
            f"{filename_obj}: the vertices must be finite in float32 and, to be normalised, not all at one point; "
            "normalization=False keeps finite vertices unchanged"
        )
    if not load_texture:
        return vertices, faces
    return vertices, faces, _textures(filename_obj, obj, texture_size, texture_wrapping, use_bilinear)


def _read_obj(filename: str) -> _Obj:
    obj = _Obj()
    _check_file(filename)
    with open(filename, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            keyword, _, rest = line.strip().partition(" ")
            try:
                if keyword == "v":
                    obj.vertices.extend(_numbers(rest, 3))
                elif keyword == "vt":
                    obj.uv.extend(_numbers(rest, 2))
                elif keyword == "f":
                    _add_polygon(obj, rest)
                elif keyword == "usemtl":
                    obj.materials.append((rest.strip(), len(obj.faces) // 3))
                elif keyword == "mtllib":
                    obj.libraries.append(rest.strip())
            except (ValueError, IndexError, OverflowError) as error:
                raise ValueError(f"{filename}, line {number}: {line.strip()[:200]!r} cannot be read: {error}") from None
    if not obj.vertices or not obj.faces:
        missing = "vertices (lines `v x y z`)" if not obj.vertices else "faces (lines `f 1 2 3`)"
        raise ValueError(f"{filename} has no {missing}")
    for name, numbers, count in (
        ("vertex", obj.faces, len(obj.vertices) // 3),
        ("texture coordinate", obj.uv_faces, len(obj.uv) // 2),
    ):
        if (last := max(numbers)) >= count:
            raise ValueError(f"{filename}: a face refers to {name} {last + 1}, but there are {count}")
    return obj


def _check_file(filename: str) -> None:
    """Refuses pipes (reading one would wait) and files that are too large. `open` reports a missing file."""
    if os.path.exists(filename) and not os.path.isfile(filename):
        raise ValueError(f"{filename} is not a regular file")
    if os.path.exists(filename) and os.path.getsize(filename) > _MOST_BYTES:
        raise ValueError(f"{filename} has {os.path.getsize(filename)} bytes; at most {_MOST_BYTES} are read")


def _numbers(rest: str, count: int) -> tuple[float, ...]:
    values = tuple(float(x) for x in rest.split()[:count])
    if len(values) < count or not all(abs(value) <= _LARGEST for value in values):
        raise ValueError(f"{count} numbers are needed, finite in float32")
    return values


def _add_polygon(obj: _Obj, line: str) -> None:
    """Adds the fan of a polygon. Of a long line the corners are taken one by one, for there may be millions of them."""
    corners = line.split() if len(line) < 2**16 else (word[0] for word in re.finditer(r"\S+", line))
    points, uvs, num_points, num_uvs = array("i"), array("i"), len(obj.vertices) // 3, len(obj.uv) // 2
    for corner in corners:
        part = corner.split("/", 2)
        points.append(_index(part[0], num_points))
        if len(part) > 1 and part[1]:
            uvs.append(_index(part[1], num_uvs))
    if len(points) < 3:
        raise ValueError("a face needs three corners")
    for i in range(1, len(points) - 1):
        obj.faces.extend((points[0], points[i], points[i + 1]))
        obj.uv_faces.extend((uvs[0], uvs[i], uvs[i + 1]) if len(uvs) == len(points) else (-1, -1, -1))


def _index(text: str, count: int) -> int:
    """Index from 0. In the file 1 is the first element, and negative numbers count back from the last one read."""
    index = int(text)
    if index == 0 or index < -count:
        raise ValueError(f"there is no element {index}")
    return index - 1 if index > 0 else count + index


def load_mtl(filename_mtl: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Colours ``Kd`` and image names ``map_Kd`` of the materials of an .mtl file."""
    colors, images, material = {}, {}, ""
    _check_file(filename_mtl)
    with open(filename_mtl, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            keyword, _, rest = line.strip().partition(" ")
            if keyword == "newmtl":
                material = rest.strip()
            elif keyword == "map_Kd":
                images[material] = rest.strip().replace("\\", "/")
            elif keyword == "Kd":
                try:
                    colors[material] = np.array(_numbers(rest, 3), dtype=np.float32)
                except ValueError as error:
                    raise ValueError(
                        f"{filename_mtl}, line {number}: {line.strip()!r} cannot be read: {error}"
                    ) from None
    return colors, images


def _textures(filename_obj: str, obj: _Obj, texture_size: int, wrapping: str, bilinear: bool) -> Tensor:
    if not obj.libraries:
        raise ValueError(
            f"{filename_obj} names no .mtl file (line `mtllib ...`); call load_obj with load_texture=False"
        )
    folder = os.path.dirname(filename_obj)
    colors, images = {}, {}
    for library in obj.libraries:
        for one in [library] if os.path.exists(os.path.join(folder, library)) else library.split():
            more_colors, more_images = load_mtl(os.path.join(folder, one))
            colors.update(more_colors)
            images.update(more_images)
    uv_faces, uvs = np.array(obj.uv_faces).reshape(-1, 3), np.array(obj.uv, np.float32).reshape(-1, 2)
    textures = np.full((len(uv_faces), texture_size, texture_size, texture_size, 3), _GREY, dtype=np.float32)
    faces_of: dict[str, list[np.ndarray]] = {}
    ends = [first for _, first in obj.materials[1:]] + [len(uv_faces)]
    for (name, first), end in zip(obj.materials, ends, strict=True):
        faces_of.setdefault(name, []).append(np.arange(first, end))
    for name, runs in faces_of.items():
        faces = np.concatenate(runs)
        if name in colors:
            textures[faces] = colors[name]
        chosen = faces[(uv_faces[faces] >= 0).all(1)]
        if name in images and len(chosen):
            path = os.path.join(folder, images[name])
            if not os.path.exists(path):  # map_Kd may have options before the file name
                path = os.path.join(folder, (images[name].split() or [""])[-1])
            textures[chosen] = bake_textures(read_image(path), uvs[uv_faces[chosen]], texture_size, wrapping, bilinear)
    return torch.from_numpy(textures)


def bake_textures(image: np.ndarray, uv: np.ndarray, texture_size: int, wrapping: str, bilinear: bool) -> np.ndarray:
    """Texture cubes ``[F, ts, ts, ts, 3]`` of faces with texture coordinates ``uv [F, 3, 2]`` in ``image [H, W, 3]``.

    Texel (i, j, k) is the image at ``(i uv0 + j uv1 + k uv2) / (i + j + k)``, texel (0, 0, 0) at (0, 0); (0, 0) is the
    centre of the pixel at the lower left, (1, 1) of that at the upper right. float32.

    As in the published renderer the *corners* of a face are wrapped: a face over a seam of the image is drawn
    backwards across it (split such faces, or use :class:`nmr.UVTexture`, which wraps at each pixel), and
    "CLAMP_TO_BORDER" is black everywhere. Faces within one copy of the image keep their exact coordinates, 0 and 1
    included (the published kernel wraps them again in each thread and exchanges 0 and 1 at random).
    """
    ts = texture_size
    if wrapping == "CLAMP_TO_BORDER":
        return np.zeros((len(uv), ts, ts, ts, 3), dtype=np.float32)
    axis = np.linspace(0, 1, ts, dtype=np.float32)
    weights = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    weights /= np.maximum(weights.sum(1, keepdims=True), np.float32(1e-12))
    points = weights @ _wrap(np.asarray(uv, dtype=np.float32), wrapping)  # [F, ts^3, 2]
    flipped = image[::-1].astype(np.float32)
    if bilinear:
        grid, source = torch.from_numpy(2 * points - 1), torch.tensor(flipped).permute(2, 0, 1)
        colors = torch.nn.functional.grid_sample(source[None], grid[None], padding_mode="border", align_corners=True)
        return colors[0].permute(1, 2, 0).reshape(len(uv), ts, ts, ts, 3).numpy()
    x, y = np.floor(points * np.float32([image.shape[1] - 1, image.shape[0] - 1]) + 0.5).astype(np.int64).T
    return flipped[y.T, x.T].reshape(len(uv), ts, ts, ts, 3)


def _wrap(uv: np.ndarray, wrapping: str) -> np.ndarray:
    if wrapping == "CLAMP_TO_EDGE":
        return uv.clip(0, 1)
    if wrapping == "MIRRORED_REPEAT":
        return 1 - np.abs(np.mod(uv, 2) - 1)
    # If one copy of the image holds the whole face, use that copy; else wrap each corner by itself.
    low, high = uv.min(1, keepdims=True), uv.max(1, keepdims=True)
    copy = np.minimum(np.floor(low), np.maximum(np.ceil(high) - 1, 0))
    return np.where(high <= copy + 1, uv - copy, np.mod(uv, 1))
