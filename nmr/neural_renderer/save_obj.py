"""Meshes as Wavefront .obj files, texture cubes as an image with one tile per face."""

from __future__ import annotations

import os

import numpy as np
import torch
from torch import Tensor

import nmr
from nmr._validate import describe
from nmr.neural_renderer._convert import check_textures

_EPS = 1e-5  # keeps texture coordinates below the last texel


def create_texture_image(
    textures: Tensor, texture_size_out: int = 16
) -> tuple[np.ndarray, np.ndarray]:
    """One image that holds the texture cubes of all faces, and the texture coordinates that find
    them there.

    Parameters
    ----------
    textures : Tensor [F, ts, ts, ts, 3]
    texture_size_out : int
        T, pixels per side of a face's square tile; at least 2. The triangle takes half of it.

    Returns
    -------
    image : float32 array [H, W, 3]
        Row 0 = top; the tiles of faces 0, 1, ... run from left to right, rows of tiles from the
        bottom to the top.
    uv : float32 array [F, 3, 2]
        Texture coordinates of each face's corners; (0, 0) is the pixel at the lower left, (1, 1)
        at the upper right.
    """
    textures = _one_mesh(textures)
    if texture_size_out < 2:
        raise ValueError(f"texture_size_out must be at least 2, got {texture_size_out}")
    if textures.shape[1] == 1:
        textures = textures.expand(-1, 2, 2, 2, -1)
    num_faces, size = len(textures), texture_size_out
    columns = int((num_faces - 1) ** 0.5) + 1
    rows = (num_faces - 1) // columns + 1

    # Corners of a tile are at its pixels (0, 0), (0, T - 1), (T - 1, T - 1). x and y run from 0
    # to 1 over the tile.
    y, x = np.mgrid[:size, :size] / (size - 1)
    weights = np.stack([1 - y, y - x, x], axis=-1) / (1 + _EPS)
    texels = _blend(textures.detach().cpu().float().numpy(), weights.reshape(-1, 3))
    tiles = np.zeros((rows * columns, size, size, 3), dtype=np.float32)
    tiles[:num_faces] = texels.reshape(num_faces, size, size, 3)
    # The pixels next to the diagonal repeat it, so that interpolation at this edge mixes in no
    # other colour.
    rim = np.arange(size - 1)
    tiles[:, rim, rim + 1] = tiles[:, rim, rim]
    image = (
        tiles.reshape(rows, columns, size, size, 3)
        .swapaxes(1, 2)
        .reshape(rows * size, columns * size, 3)
    )

    row, column = np.divmod(np.arange(num_faces), columns)
    low = np.stack([column, row], axis=-1) * size
    high = low + size - 1
    uv = np.stack([low, np.stack([low[:, 0], high[:, 1]], axis=-1), high], axis=1).astype(
        np.float32
    )
    uv /= np.array([image.shape[1] - 1, image.shape[0] - 1], dtype=np.float32)
    return image[::-1], uv


def _blend(textures: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Trilinear samples ``[F, N, C]`` of cubes ``[F, ts, ts, ts, C]`` at barycentric
    ``weights [N, 3]``.
    """
    ts = textures.shape[1]
    position = np.clip(weights * (ts - 1), 0, ts - 1 - _EPS)
    low = np.floor(position).astype(np.int64)
    fraction = position - low
    texels = textures.reshape(len(textures), ts**3, -1)
    samples = 0
    for corner in np.ndindex(2, 2, 2):
        index = np.ravel_multi_index(tuple((low + corner).T), (ts, ts, ts))
        share = np.where(corner, fraction, 1 - fraction).prod(1).astype(np.float32)
        samples = samples + share[:, None] * texels[:, index]
    return samples


def _one_mesh(textures: Tensor) -> Tensor:
    if isinstance(textures, Tensor) and textures.ndim == 5 and len(textures) > 0:
        return check_textures(textures[None], 1, len(textures))[0]
    raise ValueError(
        f"textures must be those of one mesh, a tensor [F, ts, ts, ts, 3] with F > 0, got {describe(textures)}"
    )


def save_obj(
    filename: str | os.PathLike, vertices: Tensor, faces: Tensor, textures: Tensor | None = None
) -> None:
    """Writes a mesh; with textures also ``name.mtl`` and the image ``name.png``, in the folder of
    ``name.obj``.

    Parameters
    ----------
    filename : str or path
        Ends in .obj.
    vertices : Tensor [V, 3]
        float32 values come back exactly.
    faces : integer Tensor [F, 3]
    textures : Tensor [F, ts, ts, ts, 3], optional
        In [0, 1]; values outside are clamped. Written as tiles of 16 x 16 pixels of 8 bits, see
        :func:`create_texture_image`. Needs Pillow.

    Raises
    ------
    ValueError
        For wrong shapes, or another ending. Nothing is written then.
    ImportError
        If there are textures and Pillow is missing.

    >>> nr.save_obj("out.obj", vertices[0], faces[0], textures[0])
    """
    colors = None
    if textures is not None:
        if len(_one_mesh(textures)) != len(faces):
            raise ValueError(
                f"textures must be one per face, {len(faces)}, got {describe(textures)}"
            )
        image, uv = (torch.from_numpy(x.copy()) for x in create_texture_image(textures))
        corners = torch.arange(3 * len(faces), device="cpu").view(-1, 3)
        colors = nmr.UVTexture(image, uv.reshape(-1, 2), corners)
    nmr.save_obj(filename, vertices, faces, colors)
