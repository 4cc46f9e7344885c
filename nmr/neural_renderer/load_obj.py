"""Wavefront .obj files, with their materials baked into texture cubes."""

from __future__ import annotations

import os
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from nmr.neural_renderer._images import read_image

texture_wrapping_dict = {"REPEAT": 0, "MIRRORED_REPEAT": 1, "CLAMP_TO_EDGE": 2, "CLAMP_TO_BORDER": 3}
_GREY = 0.5  # colour of faces without a material
_LARGEST = float(np.finfo(np.float32).max)
_MOST_BYTES = 2**30  # limit of an .obj or .mtl file; reading one takes some 30 times its size


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

    As published, faces of fewer than three corners add nothing, and texture coordinates are read only with
    ``load_texture``. A ``vt`` with one number has v = 0.

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
        Only with ``load_texture``: the image of a material, or else its colour ``Kd``, or else grey.

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
    _check_wrapping(texture_wrapping)
    obj = _read_obj(filename_obj, with_uv=load_texture)
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


def load_textures(
    filename_obj: str | os.PathLike,
    filename_mtl: str | os.PathLike,
    texture_size: int,
    texture_wrapping: str = "REPEAT",
    use_bilinear: bool = True,
) -> Tensor:
    """The textures ``[F, ts, ts, ts, 3]`` of a mesh, with the materials of ``filename_mtl``: see :func:`load_obj`.

    >>> textures = nr.load_obj("chair.obj", load_texture=True)[2]  # with the materials that the file names
    """
    filename_obj, filename_mtl = os.fspath(filename_obj), os.fspath(filename_mtl)
    _check_wrapping(texture_wrapping)
    obj = _read_obj(filename_obj, with_uv=True)
    return _textures(filename_obj, obj, texture_size, texture_wrapping, use_bilinear, filename_mtl)


def _check_wrapping(wrapping: str) -> None:
    if wrapping not in texture_wrapping_dict:
        raise ValueError(f"texture_wrapping must be one of {', '.join(texture_wrapping_dict)}, got {wrapping!r}")


def _keyword(line: str) -> tuple[str, str]:
    """The first word of a line, and the rest."""
    keyword, *rest = line.split(None, 1)
    return keyword, rest[0].rstrip() if rest else ""


def _without_comment(text: str) -> str:
    """``text`` before a ``#`` that begins a word; names may hold one inside."""
    return re.split(r"(?:^|\s)#", text, maxsplit=1)[0].rstrip()


def _read_obj(filename: str, with_uv: bool) -> _Obj:
    """Without ``with_uv``, texture coordinates are skipped, and those of faces are -1."""
    obj = _Obj()
    _check_file(filename)
    with open(filename, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            if line.isspace():
                continue
            keyword, rest = _keyword(line)
            try:
                if keyword == "v":
                    obj.vertices.extend(_numbers(rest.split(None, 3), 3))
                elif keyword == "vt" and with_uv:
                    obj.uv.extend(_numbers([*_without_comment(rest).split(None, 2)[:2], "0"], 2))  # v is 0 if missing
                elif keyword == "f":
                    _add_polygon(obj, _without_comment(rest), with_uv)
                elif keyword == "usemtl":
                    obj.materials.append((_without_comment(rest), len(obj.faces) // 3))
                elif keyword == "mtllib":
                    obj.libraries.append(rest)
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


def _numbers(words: list[str], count: int) -> tuple[float, ...]:
    values = tuple(float(word) for word in words[:count])
    if len(values) < count or not all(abs(value) <= _LARGEST for value in values):
        raise ValueError(f"{count} numbers are needed, finite in float32")
    return values


def _add_polygon(obj: _Obj, line: str, with_uv: bool) -> None:
    """Adds the fan of a polygon. Of a long line the corners are taken one by one, for there may be millions of them."""
    corners = line.split() if len(line) < 2**16 else (word[0] for word in re.finditer(r"\S+", line))
    points, uvs, num_points, num_uvs = array("i"), array("i"), len(obj.vertices) // 3, len(obj.uv) // 2
    for corner in corners:
        part = corner.split("/", 2)
        points.append(_index(part[0], num_points))
        if with_uv and len(part) > 1 and part[1]:
            uvs.append(_index(part[1], num_uvs))
    if not points:
        raise ValueError("a face needs corners")
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
            if line.isspace():
                continue
            keyword, rest = _keyword(line)
            if keyword == "newmtl":
                material = _without_comment(rest)
            elif keyword == "map_Kd":
                images[material] = rest.replace("\\", "/")
            elif keyword == "Kd":
                try:
                    colors[material] = np.array(_numbers(rest.split(None, 3), 3), dtype=np.float32)
                except ValueError as error:
                    raise ValueError(
                        f"{filename_mtl}, line {number}: {line.strip()!r} cannot be read: {error}"
                    ) from None
    return colors, images


def _libraries(folder: str, obj: _Obj) -> Iterator[str]:
    """The .mtl files of an .obj file. A line may hold one name with spaces, or several names."""
    for line in obj.libraries:
        whole = [name for name in (line, _without_comment(line)) if os.path.exists(os.path.join(folder, name))]
        for name in whole[:1] or _without_comment(line).split():
            yield os.path.join(folder, name)


def _image(folder: str, line: str) -> str:
    """The file of a line ``map_Kd``. Options may come before the name, and a comment after it."""
    short = _without_comment(line)
    names = (line, short, (short.split() or [""])[-1])
    paths = [os.path.join(folder, name) for name in names]
    return next((path for path in paths if os.path.exists(path)), paths[-1])


def _textures(
    filename_obj: str, obj: _Obj, texture_size: int, wrapping: str, bilinear: bool, library: str | None = None
) -> Tensor:
    folder = os.path.dirname(filename_obj)
    libraries = [library] if library is not None else list(_libraries(folder, obj))
    if not libraries:
        raise ValueError(
            f"{filename_obj} names no .mtl file (line `mtllib ...`); call load_obj with load_texture=False"
        )
    colors, images = {}, {}
    for library in libraries:
        more_colors, more_images = load_mtl(library)
        colors.update(more_colors)
        images.update(more_images)
    uv_faces, uvs = np.array(obj.uv_faces).reshape(-1, 3), np.array(obj.uv, np.float32).reshape(-1, 2)
    textures = np.full((len(uv_faces), texture_size, texture_size, texture_size, 3), _GREY, dtype=np.float32)
    faces_of: dict[str, list[np.ndarray]] = {}
    ends = [first for _, first in obj.materials[1:]] + [len(uv_faces)]
    for (name, first), end in zip(obj.materials, ends, strict=True):
        if name not in colors and name not in images:  # as published, the first word counts
            name = (name.split() or [""])[0]
        faces_of.setdefault(name, []).append(np.arange(first, end))
    for name, runs in faces_of.items():
        faces = np.concatenate(runs)
        if name in colors:
            textures[faces] = colors[name]
        chosen = faces[(uv_faces[faces] >= 0).all(1)]
        if name in images and len(chosen):
            image, uv = read_image(_image(folder, images[name])), uvs[uv_faces[chosen]]
            textures[chosen] = bake_textures(image, uv, texture_size, wrapping, bilinear)
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
