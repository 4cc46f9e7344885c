"""Colours for the vertices of a mesh from the picture to which it was fitted.

Hidden parts get blurred colours of their neighbours.
"""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree
from torch import Tensor

import nmr
from learn3d.pictures import Surface
from learn3d.studio.picture_to_mesh.fit import Target, View
from learn3d.studio.picture_to_mesh.options import DEFAULTS, ColorOptions
from learn3d.studio.picture_to_mesh.smoothing import divide, joined

DEPTH_SIZE = 256  # side of the depth map that decides which vertices are visible

#: Colours [N, 3] in [0, 1] at points [N, 3] of a surface with normals [N, 3], and their reliability [N] in [0, 1].
LookUp = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def color_mesh(
    mesh: tuple[Tensor, Tensor],
    view: View,
    target: Target,
    mirror: Tensor | None = None,
    options: ColorOptions = DEFAULTS.color,
) -> Surface:
    """A surface with the colours of a picture. Hidden vertices get the colours of their mirror images or, if these are
    hidden, too, those of clearly seen parts at the same height, blended with their neighbours'.

    mesh: vertices float32 [V, 3] in the object frame, and faces int64 [F, 3], whose long edges are
    divided, so that the vertices show the picture. view: the picture's camera. mirror: float32
    [3, 3], the reflection that maps the shape to itself, None without symmetry.
    """
    mesh = divide(*mesh, options.coarse)
    look_up_seen = _seen(*mesh, view, target, options)

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
    normals = nmr.vertex_normals(*mesh)
    colors = _spread(*look_up(vertices, normals), *mesh, normals, options)
    with_colors, faces = divide(torch.cat([vertices, colors], 1), faces, options.fine)
    vertices, plain = with_colors.split(3, 1)
    found, reliable = look_up(vertices, nmr.vertex_normals(vertices, faces))
    share = (reliable.square() / (reliable.square() + options.sure))[:, None]
    return Surface(vertices, faces, (share * found + (1 - share) * plain).clamp(0, 1))


def clash(
    mesh: tuple[Tensor, Tensor],
    view: View,
    target: Target,
    mirror: Tensor,
    options: ColorOptions = DEFAULTS.color,
) -> float:
    """The mean difference of a picture's colours at points of a surface and at their mirror images, if seen."""
    corners = mesh[0][mesh[1]]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    points, normals = corners.mean(1), F.normalize(cross, dim=1)
    look_up = _seen(*mesh, view, target, options)
    own, weight = look_up(points, normals)
    other, its_weight = look_up(points @ mirror.T, normals @ mirror.T)
    share = weight * its_weight * cross.norm(dim=1)
    return float((share * (own - other).abs().mean(1)).sum() / share.sum().clamp(min=1e-6))


def _seen(
    vertices: Tensor, faces: Tensor, view: View, target: Target, options: ColorOptions
) -> LookUp:
    """The colours of a picture at the points of a surface that it shows."""
    camera = view.cameras()
    depth_map = nmr.render_depth(
        vertices, faces, camera, image_size=DEPTH_SIZE, anti_aliasing=False
    )
    pixels, outside = target.pixels[:3], (target.pixels[3:] <= 0.5).float()
    near = [F.max_pool2d(outside, 2 * width + 1, 1, width) for width in (1, options.border)]
    reliable = 1 - sum(near) / 2
    reliable[:, torch.from_numpy(_contour(target, options))] *= options.drawn

    def look_up(points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        x, y, z = camera.transform(points)[0].unbind(1)
        grid = torch.stack([x, -y], 1)[None, None]
        found, depth, trusted = (
            F.grid_sample(v[None], grid, padding_mode="border", align_corners=False)[0, :, 0]
            for v in (pixels, depth_map, reliable)
        )
        to_eye = F.normalize(camera.eye - points, dim=1)
        slant = (((normals * to_eye).sum(1) - options.grazing) / (0.6 - options.grazing)).clamp(
            0, 1
        )
        visible = (z < depth[0] + options.behind) & (x.abs() < 1) & (y.abs() < 1)
        return found.T, visible * slant * trusted[0]

    return look_up


def _contour(target: Target, options: ColorOptions) -> np.ndarray:
    """The pixels of a line that a drawing has along its outline, bool [S, S]: hidden parts do not get its colour."""
    pixels, depth = target.pixels[:3].numpy(), distance_transform_edt(target.pixels[3] > 0.5)
    rim, core = (depth > 1) & (depth <= 3), depth > options.contour
    if not (rim.any() and core.any()):
        return np.zeros_like(core)
    alike = np.abs(pixels - np.median(pixels[:, rim], 1)[:, None, None]).max(0) < options.even
    drawn = alike[rim].mean() > 1 - options.others and alike[core].mean() < options.others
    return alike & (depth > 0) & ~core & drawn


def _spread(
    colors: Tensor,
    weight: Tensor,
    vertices: Tensor,
    faces: Tensor,
    normals: Tensor,
    options: ColorOptions,
) -> Tensor:
    """Spread colours [V, 3] from vertices [V, 3] with a high weight [V] to the others as smoothly as possible.

    The result minimises sum_v w_v^2 |c_v - given_v|^2 + 0.01 sum_edges |c_a - c_b|^2 + s sum_v
    |c_v - like_v|^2. So seen vertices (w_v near 1) keep their colours, and neighbours become
    alike. The last term, with s = `options.spreading`, decides far from them: see `_alike`.
    """
    neighbours = joined(faces.numpy(), len(colors))
    given = weight.double().numpy()[:, None] ** 2
    colors = colors.double().numpy()
    alike = _alike(colors, weight.numpy(), vertices.numpy(), normals.numpy(), neighbours, options)
    laplacian = diags_array(neighbours.sum(1)) - neighbours
    system = (diags_array(given[:, 0] + options.spreading) + 0.01 * laplacian).tocsr()
    right = given * colors + options.spreading * alike
    scale = diags_array(1 / system.diagonal())
    solved = [cg(system, channel, M=scale, rtol=1e-7) for channel in right.T]
    if any(status for _, status in solved):
        raise RuntimeError("the colours of a mesh did not converge")
    return torch.from_numpy(np.stack([found for found, _ in solved], 1)).float().clamp(0, 1)


def _alike(
    colors: np.ndarray,
    weight: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    neighbours: coo_array,
    options: ColorOptions,
) -> np.ndarray:
    """The colours [V, 3] of clearly seen parts of the same kind as each vertex.

    They are medians over clear vertices of the same part, or of an equal one, for example another
    leg. Those at the same height whose normals point up or down alike count first: fronts and
    backs of cars get windows above paint.
    """
    count, part = connected_components(neighbours, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, points)
    np.maximum.at(high, part, points)
    best = np.zeros(count)
    np.maximum.at(best, part, weight)
    clear = weight >= best.clip(min(options.drawn, weight.max()) / 2, 0.5)[part]
    seen = np.bincount(part, clear, count)
    features = np.column_stack([0.2 * points[:, [0, 2]], points[:, 1], 0.2 * np.abs(normals[:, 1])])
    alike = np.empty_like(colors)
    for number in range(count):
        unequal = np.abs(high - low - (high - low)[number]).max(1)
        unequal += np.abs(low - low[number])[:, 1]
        source = np.where(seen > 0, unequal, np.inf).argmin()
        rows = np.flatnonzero(
            clear & (part == source) if unequal[source] < options.equal else clear
        )
        here = np.flatnonzero(part == number)
        nearest = cKDTree(features[rows]).query(features[here], min(options.neighbours, len(rows)))[
            1
        ]
        alike[here] = np.median(colors[rows[nearest.reshape(len(here), -1)]], 1)
    return alike
