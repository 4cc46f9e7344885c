"""Colours for a mesh from the picture to which it was fitted; hidden parts get blurred colours of their neighbours."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from torch import Tensor

import nmr
from learn3d.fitting.camera import View
from learn3d.fitting.smoothing import joined, sharpen
from learn3d.fitting.texturing import paint
from learn3d.pictures.surfaces import Surface

DEPTH_SIZE = 256  # side of the depth map that decides which vertices are visible
BEHIND = 0.02  # distance behind the depth map from which a vertex is hidden, in units of the object frame
GRAZING = 0.25  # cosine between normal and line of sight below which a colour is not used
EQUAL = 0.06  # two parts are equal if the sizes of their boxes and their heights above the ground differ by less
BORDER = 2  # width in pixels of the border inside the outline that may have the background's colours; its inner
# pixels count half, as thin legs have no others


def color_mesh(
    vertices: Tensor,
    faces: Tensor,
    view: View,
    colors: np.ndarray,
    mask: np.ndarray,
    mirror: Tensor | None = None,
    *,
    textured: bool = False,
) -> Surface:
    """A surface with the colours of a picture. Hidden vertices get the colours of their mirror images or, if these are
    hidden, too, blurred colours of their neighbours.

    vertices float32 [V, 3] in the object frame, faces int64 [F, 3]; view: the picture's camera; colors uint8
    [S, S, 3] and mask uint8 [S, S]: the picture, framed as in `fitting.camera`; mirror: float32 [3, 3], the reflection
    that maps the shape to itself, None without symmetry. textured: double the vertices along sharp edges, and add a
    texture image.
    """
    picture = _Picture(vertices, faces, view, colors, mask)

    def look_up(points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        seen, weight = picture.look_up(points, normals)
        if mirror is None:
            return seen, weight
        other, its_weight = picture.look_up(points @ mirror.T, normals @ mirror.T)
        its_weight = (1 - weight) * its_weight  # a point's own colour comes first
        both = weight + its_weight
        mixed = weight[:, None] * seen + its_weight[:, None] * other
        return mixed / both.clamp(min=1e-6)[:, None], both

    found = look_up(vertices, nmr.vertex_normals(vertices, faces))
    surface = Surface(vertices, faces, _spread(*found, vertices, faces))
    return paint(sharpen(surface), look_up) if textured else surface


class _Picture:
    """A picture with the depth of the surface that it shows."""

    def __init__(self, vertices: Tensor, faces: Tensor, view: View, colors: np.ndarray, mask: np.ndarray) -> None:
        self.view, self.camera = view, view.cameras()
        placed = view.place(vertices[None])
        self.depth = nmr.render_depth(placed, faces, self.camera, image_size=DEPTH_SIZE, anti_aliasing=False)[None]
        self.pixels = torch.from_numpy(colors.astype(np.float32) / 255).permute(2, 0, 1)[None]
        inside = torch.from_numpy((mask > 127).astype(np.float32))[None, None]
        self.trusted = sum(1 - F.max_pool2d(1 - inside, 2 * width + 1, 1, width) for width in (1, BORDER)) / 2

    def look_up(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Colours [N, 3] in [0, 1] at points of the surface, and their reliability [N] in [0, 1]."""
        placed = self.view.place(points[None])
        x, y, z = self.camera.transform(placed)[0].unbind(1)
        grid = torch.stack([x, -y], 1)[None, None]
        depth, trusted = (_sample(image, grid)[0, 0, 0] for image in (self.depth, self.trusted))
        to_eye = F.normalize(self.camera.eye[0].float() - placed[0], dim=1)
        slant = (((normals * to_eye).sum(1) - GRAZING) / (0.6 - GRAZING)).clamp(0, 1)
        visible = (z < depth + BEHIND) & (x.abs() < 1) & (y.abs() < 1)
        return _sample(self.pixels, grid)[0, :, 0].T, visible * slant * trusted


def _sample(image: Tensor, grid: Tensor) -> Tensor:
    return F.grid_sample(image, grid, padding_mode="border", align_corners=False)


def _spread(colors: Tensor, weight: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """Spread colours [V, 3] from vertices [V, 3] with a high weight [V] to the others as smoothly as possible.

    The result minimises sum_v w_v^2 |c_v - given_v|^2 + 0.01 sum_edges |c_a - c_b|^2 + 1e-5 sum_v |c_v - near_v|^2.
    So seen vertices (w_v near 1) keep their colours, and neighbours become alike. The last term decides on parts that
    no edge joins to a seen vertex: near_v is the colour of the nearest vertex that is clearly seen, or of the
    corresponding one of an equal part.
    """
    clear = (weight >= min(0.5, float(weight.max()))).numpy()
    neighbours = joined(faces.numpy(), len(colors))
    given, nearest = weight.double().numpy()[:, None] ** 2, _nearest_clear(vertices.numpy(), clear, neighbours)
    laplacian = diags_array(neighbours.sum(1)) - neighbours
    system = (diags_array(given[:, 0] + 1e-5) + 0.01 * laplacian).tocsc()
    colors = colors.double().numpy()
    right = given * colors + 1e-5 * colors[nearest]
    return torch.from_numpy(np.asarray(spsolve(system, right))).float().clamp(0, 1)


def _nearest_clear(points: np.ndarray, clear: np.ndarray, neighbours: coo_array) -> np.ndarray:
    """Index of the clear point nearest to each point [V, 3]; in a part without any, of the one nearest to its place
    in an equal part, for example another leg.
    """
    nearest = np.flatnonzero(clear)[cKDTree(points[clear]).query(points)[1]]
    count, part = connected_components(neighbours, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, points)
    np.maximum.at(high, part, points)
    seen = np.bincount(part, clear, count)
    for hidden in np.flatnonzero(seen == 0):
        unequal = np.abs(high - low - (high - low)[hidden]).max(1) + np.abs(low - low[hidden])[:, 1]
        other = np.where(seen > 0, unequal, np.inf).argmin()
        if unequal[other] < EQUAL:
            there, here = np.flatnonzero((part == other) & clear), part == hidden
            moved = points[here] + (low[other] + high[other] - low[hidden] - high[hidden]) / 2
            nearest[here] = there[cKDTree(points[there]).query(moved)[1]]
    return nearest
