"""Wavefront .obj files, with their materials baked into texture cubes."""

from __future__ import annotations

import os

import numpy as np
import torch
from torch import Tensor

from nmr._images import read_image
from nmr.obj import Obj, find_image, find_libraries, load, match_materials, read_mtl

texture_wrapping_dict = {
    "REPEAT": 0,
    "MIRRORED_REPEAT": 1,
    "CLAMP_TO_EDGE": 2,
    "CLAMP_TO_BORDER": 3,
}
_GREY = 0.5  # colour of faces without a material
load_mtl = read_mtl  # its published name


def load_obj(
    filename_obj: str | os.PathLike,
    normalization: bool = True,
    texture_size: int = 4,
    load_texture: bool = False,
    texture_wrapping: str = "REPEAT",
    use_bilinear: bool = True,
) -> tuple[Tensor, Tensor] | tuple[Tensor, Tensor, Tensor]:
    """Read a mesh; polygons become fans of triangles.

    Unlike the published function, a polygon that its fan would overfill (a concave one) is cut
    along its own diagonals. As published, faces of fewer than three corners add nothing, and
    texture coordinates are read only with ``load_texture``. A ``vt`` with one number has v = 0.
    :func:`nmr.load_obj` keeps texture coordinates and images.

    Parameters
    ----------
    filename_obj : str or path
    normalization : bool
        Move and scale the mesh so that its box is centred on the origin with longest side 2. It
        is computed in float64, so that large coordinates (UTM) lose nothing.
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
        Only with ``load_texture``: the image of a material, or else its colour ``Kd``, or else
        grey. A warning counts the faces without a known material.

    Raises
    ------
    ValueError
        For a file without vertices or faces, for a line that cannot be read or that refers to
        missing elements (the message gives file and line), for another wrapping, and with
        ``load_texture`` for a file that names no .mtl.
    FileNotFoundError
        For a missing .obj, .mtl or image.
    ImportError
        If an image is wanted and Pillow is missing.

    >>> vertices, faces, textures = nr.load_obj("chair.obj", texture_size=8, load_texture=True)
    """
    filename_obj = os.fspath(filename_obj)
    _check_wrapping(texture_wrapping)
    obj = load(filename_obj, with_uv=load_texture)
    points = obj.vertices
    if normalization:
        points = points - points.min(0)
        with np.errstate(invalid="ignore"):  # 0 / 0, refused below
            points = points / points.max() * 2
        points = points - points.max(0) / 2
    with np.errstate(over="ignore"):
        vertices = torch.from_numpy(points.astype(np.float32))
    faces = torch.from_numpy(obj.faces)
    if not vertices.isfinite().all():
        raise ValueError(
            f"{filename_obj}: the vertices must be finite in float32 and, to be normalised, not all at one point; "
            "normalization=False keeps finite vertices unchanged"
        )
    if not load_texture:
        return vertices, faces
    return (
        vertices,
        faces,
        _textures(filename_obj, obj, texture_size, texture_wrapping, use_bilinear),
    )


def load_textures(
    filename_obj: str | os.PathLike,
    filename_mtl: str | os.PathLike,
    texture_size: int,
    texture_wrapping: str = "REPEAT",
    use_bilinear: bool = True,
) -> Tensor:
    """The textures ``[F, ts, ts, ts, 3]`` of a mesh, with the materials of ``filename_mtl``: see
    :func:`load_obj`.

    >>> textures = nr.load_obj("chair.obj", load_texture=True)[2]  # with the materials that the file names
    """
    filename_obj, filename_mtl = os.fspath(filename_obj), os.fspath(filename_mtl)
    _check_wrapping(texture_wrapping)
    obj = load(filename_obj, with_uv=True)
    return _textures(filename_obj, obj, texture_size, texture_wrapping, use_bilinear, filename_mtl)


def _check_wrapping(wrapping: str) -> None:
    if wrapping not in texture_wrapping_dict:
        raise ValueError(
            f"texture_wrapping must be one of {', '.join(texture_wrapping_dict)}, got {wrapping!r}"
        )


def _textures(
    filename_obj: str,
    obj: Obj,
    texture_size: int,
    wrapping: str,
    bilinear: bool,
    library: str | None = None,
) -> Tensor:
    folder = os.path.dirname(filename_obj)
    libraries = [library] if library is not None else find_libraries(folder, obj.libraries)
    if not libraries:
        raise ValueError(
            f"{filename_obj} names no .mtl file (line `mtllib ...`); call load_obj with load_texture=False"
        )
    colors, images = {}, {}
    for library in libraries:
        more_colors, more_images = load_mtl(library)
        colors.update(more_colors)
        images.update(more_images)
    names = match_materials(obj.materials, obj.face_material, {**colors, **images}, filename_obj)
    textures = np.full(
        (len(obj.faces), texture_size, texture_size, texture_size, 3), _GREY, dtype=np.float32
    )
    has_uv = obj.uv_faces[:, 0] >= 0
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    of_face = np.array([numbers[name] for name in names])[obj.face_material]
    order = np.argsort(of_face, kind="stable")
    groups = np.split(order, np.searchsorted(of_face[order], range(1, len(numbers))))
    for name, faces in zip(numbers, groups, strict=True):
        if name in colors:
            textures[faces] = colors[name]
        chosen = faces[has_uv[faces]]
        if name in images and len(chosen):
            image, uv = read_image(find_image(folder, images[name])), obj.uv[obj.uv_faces[chosen]]
            textures[chosen] = bake_textures(image, uv, texture_size, wrapping, bilinear)
    return torch.from_numpy(textures)


def bake_textures(
    image: np.ndarray, uv: np.ndarray, texture_size: int, wrapping: str, bilinear: bool
) -> np.ndarray:
    """Texture cubes ``[F, ts, ts, ts, 3]`` of faces with texture coordinates ``uv [F, 3, 2]`` in
    ``image [H, W, 3]``.

    Texel (i, j, k) is the image at ``(i uv0 + j uv1 + k uv2) / (i + j + k)``, texel (0, 0, 0) at
    (0, 0); (0, 0) is the centre of the pixel at the lower left, (1, 1) of that at the upper
    right. float32.

    As in the published renderer the *corners* of a face are wrapped: a face over a seam of the
    image is drawn backwards across it (split such faces, or use :class:`nmr.UVTexture`, which
    wraps at each pixel), and "CLAMP_TO_BORDER" is black everywhere. Faces within one copy of the
    image keep their exact coordinates, 0 and 1 included (the published kernel wraps them again in
    each thread and exchanges 0 and 1 at random).
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
        colors = torch.nn.functional.grid_sample(
            source[None], grid[None], padding_mode="border", align_corners=True
        )
        return colors[0].permute(1, 2, 0).reshape(len(uv), ts, ts, ts, 3).numpy()
    x, y = (
        np.floor(points * np.float32([image.shape[1] - 1, image.shape[0] - 1]) + 0.5)
        .astype(np.int64)
        .T
    )
    return flipped[y.T, x.T].reshape(len(uv), ts, ts, ts, 3)


def _wrap(uv: np.ndarray, wrapping: str) -> np.ndarray:
    if wrapping == "CLAMP_TO_EDGE":
        return uv.clip(0, 1)
    if wrapping == "MIRRORED_REPEAT":
        return 1 - np.abs(np.mod(uv, 2) - 1)
    # If one copy of the image holds the whole face, use that copy; else wrap each corner by
    # itself.
    low, high = uv.min(1, keepdims=True), uv.max(1, keepdims=True)
    copy = np.minimum(np.floor(low), np.maximum(np.ceil(high) - 1, 0))
    return np.where(high <= copy + 1, uv - copy, np.mod(uv, 1))
