"""Makes a texture image for a mesh from a picture. Each face of the mesh has a triangle of its own in the image."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

import nmr
from learn3d.pictures.surfaces import Surface, Texture

WIDTH = 1024  # texels; the height of a texture depends on the mesh
TEXELS = 250.0  # per unit of the object frame
SIDES = (2, 4, 8, 16, 24, 32)  # sides that a triangle in the image can have, in texels
_SURE = 0.02  # squared reliability of a colour that counts as much as the colours of the vertices

LookUp = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def paint(surface: Surface, look_up: LookUp) -> Surface:
    """The surface with a texture image.

    surface: with colours and normals of its vertices. look_up: colours [N, 3] of points [N, 3] with normals [N, 3], and
    their reliability [N] in [0, 1]. Texels with a low one get the colours of the vertices.
    """
    places = _lay_out(surface.vertices[surface.faces].numpy())
    corners, shares = surface.faces[places.face[:, None], places.order], places.shares[..., None]
    normals = nmr.vertex_normals(surface.vertices, surface.faces)
    points, normals, plain = ((v[corners] * shares).sum(1) for v in (surface.vertices, normals, surface.colors))
    found, reliable = look_up(points, F.normalize(normals, dim=1))
    share = (reliable.square() / (reliable.square() + _SURE))[:, None]
    image = torch.ones(places.height, WIDTH, 3)
    image[places.row, places.column] = (share * found + (1 - share) * plain).clamp(0, 1)
    size = torch.tensor([WIDTH, -places.height])
    return surface._replace(texture=Texture(image, places.corners / size + torch.tensor([0.0, 1.0])))


class _Places(NamedTuple):
    """Layout of F faces in a texture image, and the surface points that its N used texels show."""

    height: int  # image height
    corners: Tensor  # float32 [F, 3, 2]: places of the corners in texels, x right and y down
    row: Tensor  # int64 [N]
    column: Tensor  # int64 [N]
    face: Tensor  # int64 [N]
    order: Tensor  # int64 [N, 3]: corners of the face that the shares belong to
    shares: Tensor  # float32 [N, 3]: barycentric coordinates


def _lay_out(triangles: np.ndarray) -> _Places:
    """Lay triangles [F, 3, 3] out in an image.

    Each rectangular cell of the image holds two triangles of the same size. Around a triangle one more texel continues
    its colours, so that interpolation at its sides does not read another triangle.
    """
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, 1), axis=2)
    order = (edges.argmin(1)[:, None] + np.arange(3)) % 3  # the shortest edge goes down from the first corner
    kinds = np.searchsorted(SIDES[:-1], TEXELS * np.stack([edges.max(1), edges.min(1)], 1))
    corners, texels, top = np.empty((len(triangles), 3, 2), np.float32), [], 0
    for kind in np.unique(kinds, axis=0):
        faces, sides = np.flatnonzero((kinds == kind).all(1)), np.take(SIDES, kind)
        width, height = sides + 4
        cells, across = -(-len(faces) // 2), WIDTH // width
        left, low = np.arange(cells) % across * width, top + np.arange(cells) // across * height
        top = low[-1] + height
        first = 1 + sides * np.array([(0, 0), (1, 0), (0, 1)])
        for k, own in enumerate((first, sides + 4 - first)):
            own = own + np.stack([left, low], 1)[: len(faces[k::2]), None]
            corners[faces[k::2, None], order[faces[k::2]]] = own
        y, x = np.indices((height, width))
        shares, others = _shares(x + 0.5, y + 0.5, sides), _shares(width - x - 0.5, height - y - 0.5, sides)
        is_second = shares[..., 0] < others[..., 0]
        shares = np.where(is_second[..., None], others, shares)
        pairs = np.resize(faces, (cells, 2))[:, :, None, None]
        face = np.where(is_second, pairs[:, 1], pairs[:, 0])
        row, column, shares = low[:, None, None] + y, left[:, None, None] + x, np.broadcast_to(shares, (*face.shape, 3))
        texels.append([each.reshape(row.size, -1) for each in (row, column, face, order[face], np.float32(shares))])
    row, column, face, order, shares = (torch.from_numpy(np.concatenate(each)) for each in zip(*texels, strict=True))
    return _Places(top, torch.from_numpy(corners), row[:, 0], column[:, 0], face[:, 0], order, shares)


def _shares(x: np.ndarray, y: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Barycentric coordinates [H, W, 3] of places in a cell, in its first triangle."""
    b, c = (x - 1) / sides[0], (y - 1) / sides[1]
    return np.stack([1 - b - c, b, c], -1)
