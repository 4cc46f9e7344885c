"""Inflates the outline of a picture to a smooth shape with the picture on it, for objects of unknown kinds."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.sparse import diags_array, kronsum
from scipy.sparse.linalg import spsolve
from torch import Tensor

from learn3d.pictures import Surface, grid_surface
from learn3d.studio.picture_to_mesh.fit import LENS_HALF_FOV_DEG, Target, View
from learn3d.studio.picture_to_mesh.options import DEFAULTS, SmoothOptions
from learn3d.studio.picture_to_mesh.smoothing import smooth

_HALF = 2  # pixels of half a cell


@torch.no_grad()
def inflate(target: Target, options: SmoothOptions = DEFAULTS.smooth) -> tuple[Surface, View]:
    """A shape with the outline of a picture, mirror-symmetric about the picture's plane, and its view.

    With u = 0 on the outline and
    Laplace(u) = -4 within, the surface is where z^2 = depth^2 u, so that a disc becomes an
    ellipsoid. Both sides show the picture.
    """
    mask = target.pixels[3].numpy() > 0.5
    wide = ndimage.binary_erosion(mask, iterations=options.thin)
    thin = mask & ~ndimage.binary_dilation(wide, iterations=options.thin + 1)
    # a thin part gets every cell that it touches, another part the cells that it half fills
    drawn = thin | ndimage.binary_erosion(mask, iterations=_HALF)
    inside = (
        F.adaptive_max_pool2d(torch.from_numpy(drawn)[None].float(), options.grid)[0].numpy() > 0
    )
    square = options.depth**2 * _solve(inside) - 4 * ndimage.distance_transform_edt(~inside)
    z = np.arange(options.grid) - (options.grid - 1) / 2
    field = square[::-1].T[:, :, None] - z**2
    surface = grid_surface(torch.from_numpy(0.5 + 0.5 * field / (np.abs(field) + 2)))
    vertices, faces = smooth(surface.vertices, surface.faces, rounds=options.rounds), surface.faces
    zero = torch.zeros(1)  # the grid is the picture, whatever thin parts smoothing has removed
    distance = zero + 0.5 / math.tan(math.radians(LENS_HALF_FOV_DEG))
    view = View(zero, zero, distance.log(), torch.zeros(1, 2), zero)
    x, y, _ = view.cameras().transform(vertices)[0].unbind(1)
    image = _spread(target, options.edge)
    size = image.shape[0]
    column, row = ((value * size).long().clamp(0, size - 1) for value in ((1 + x) / 2, (1 - y) / 2))
    return Surface(vertices, faces, image[row, column]), view


def _solve(inside: np.ndarray) -> np.ndarray:
    """u [S, S] with Laplace(u) = -4 in a mask, bool [S, S], and 0 elsewhere. The border of the array is outside."""
    line = diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=inside.shape)
    rows = np.flatnonzero(inside)
    laplacian = kronsum(line, line, "csr")[rows][:, rows]
    solved = np.zeros(inside.shape)
    solved[inside] = spsolve(laplacian, np.full(len(rows), -4.0))
    return solved


def _spread(target: Target, edge: int) -> Tensor:
    """The colours of a picture, float32 [S, S, 3]; outside of the object those of its nearest pixel."""
    inside = target.pixels[3].numpy() > 0.5
    inner = ndimage.binary_erosion(inside, iterations=edge)
    source = inner if inner.any() else inside
    y, x = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
    return target.pixels[:3, y, x].movedim(0, -1)
