"""Colours for the vertices of a mesh from the picture to which it was fitted.

Hidden parts get blurred colours of their neighbours.
"""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree
from torch import Tensor

import nmr
from learn3d.pictures import Surface
from learn3d.studio.picture_to_mesh.fit import View
from learn3d.studio.picture_to_mesh.smoothing import divide, joined

DEPTH_SIZE = 256  # side of the depth map that decides which vertices are visible
BEHIND = 0.02  # distance behind the depth map from which a vertex is hidden, in units of the object frame
GRAZING = 0.25  # cosine between normal and line of sight below which a colour is not used
EQUAL = 0.06  # two parts are equal if the sizes of their boxes and their heights above the ground differ by less
BORDER = 2  # width in pixels of the border inside the outline that may have the background's colours; its inner
# pixels count half, as thin legs have no others
COARSE = 0.1  # longest edge of the mesh on which the colours of hidden parts are found
FINE = 0.025  # longest edge of the coloured mesh, in units of the object frame
_SURE = 0.02  # squared reliability of a colour that counts as much as those of the neighbours

#: Colours [N, 3] in [0, 1] at points [N, 3] of a surface with normals [N, 3], and their reliability [N] in [0, 1].
LookUp = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def color_mesh(
    mesh: tuple[Tensor, Tensor],
    view: View,
    picture: np.ndarray,
    mirror: Tensor | None = None,
    fine: bool = False,
) -> Surface:
    """A surface with the colours of a picture. Hidden vertices get the colours of their mirror images or, if these are
    hidden, too, blurred colours of their neighbours.

    mesh: vertices float32 [V, 3] in the object frame, and faces int64 [F, 3]. view: the picture's camera.
    picture: R, G, B and mask, uint8 [4, S, S], framed as in `fitting.fit`. mirror: float32
    [3, 3], the reflection that maps the shape to itself, None without symmetry. fine: divide edges
    longer than `FINE`, so that the vertices show the picture.
    """
    if fine:
        mesh = divide(*mesh, COARSE)
    look_up_seen = _seen(*mesh, view, picture)

    def look_up(points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        seen, weight = look_up_seen(points, normals)
        if mirror is None:
            return seen, weight
        other, its_weight = look_up_seen(points @ mirror.T, normals @ mirror.T)
        its_weight = (1 - weight) * its_weight  # a point's own colour comes first
        both = weight + its_weight
        mixed = weight[:, None] * seen + its_weight[:, None] * other
        return mixed / both.clamp(min=1e-6)[:, None], both

    vertices, faces = mesh
    colors = _spread(*look_up(vertices, nmr.vertex_normals(*mesh)), *mesh)
    if fine:
        with_colors, faces = divide(torch.cat([vertices, colors], 1), faces, FINE)
        vertices, plain = with_colors.split(3, 1)
        found, reliable = look_up(vertices, nmr.vertex_normals(vertices, faces))
        share = (reliable.square() / (reliable.square() + _SURE))[:, None]
        colors = (share * found + (1 - share) * plain).clamp(0, 1)
    return Surface(vertices, faces, colors)


def _seen(vertices: Tensor, faces: Tensor, view: View, picture: np.ndarray) -> LookUp:
    """The colours of a picture at the points of a surface that it shows."""
    camera, size = view.cameras(), DEPTH_SIZE
    depth_map = nmr.render_depth(
        view.place(vertices[None]), faces, camera, image_size=size, anti_aliasing=False
    )
    pixels = torch.from_numpy(picture[:3].astype(np.float32) / 255)
    inside = torch.from_numpy((picture[3:] > 127).astype(np.float32))
    reliable = (
        sum(1 - F.max_pool2d(1 - inside, 2 * width + 1, 1, width) for width in (1, BORDER)) / 2
    )

    def look_up(points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        placed = view.place(points[None])
        x, y, z = camera.transform(placed)[0].unbind(1)
        grid = torch.stack([x, -y], 1)[None, None]
        options = {"padding_mode": "border", "align_corners": False}
        found, depth, trusted = (
            F.grid_sample(v[None], grid, **options)[0, :, 0] for v in (pixels, depth_map, reliable)
        )
        to_eye = F.normalize(camera.eye[0].float() - placed[0], dim=1)
        slant = (((normals * to_eye).sum(1) - GRAZING) / (0.6 - GRAZING)).clamp(0, 1)
        visible = (z < depth[0] + BEHIND) & (x.abs() < 1) & (y.abs() < 1)
        return found.T, visible * slant * trusted[0]

    return look_up


def _spread(colors: Tensor, weight: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    """Spread colours [V, 3] from vertices [V, 3] with a high weight [V] to the others as smoothly as possible.

    The result minimises sum_v w_v^2 |c_v - given_v|^2 + 0.01 sum_edges |c_a - c_b|^2 + 1e-5 sum_v
    |c_v - near_v|^2. So seen vertices (w_v near 1) keep their colours, and neighbours become
    alike. The last term decides on parts that no edge joins to a seen vertex: near_v is the
    colour of the nearest vertex that is clearly seen, or of the corresponding one of an equal
    part.
    """
    clear = (weight >= min(0.5, float(weight.max()))).numpy()
    neighbours = joined(faces.numpy(), len(colors))
    given = weight.double().numpy()[:, None] ** 2
    nearest = _nearest_clear(vertices.numpy(), clear, neighbours)
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
