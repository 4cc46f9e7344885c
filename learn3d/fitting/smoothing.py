"""Finer, smoother meshes: divided edges, sharp edges, and the outer surface of meshes that cross themselves."""

import math

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array, diags_array
from skimage.measure import marching_cubes
from torch import Tensor
from trimesh.smoothing import filter_taubin

import nmr
from learn3d.pictures.surfaces import Surface

ROUNDS = 4  # rounds of Taubin's smoothing, each of which shrinks the mesh and grows it again
CELLS = 112  # cells of the grid of `outer_surface` along the longest side
DEPTH_SIDE = 320  # side of its depth maps in pixels
_RIM = 4  # empty cells around the shape
_GROWTH = 1.0  # cells by which the shape is thickened at first, to keep thin parts


def smooth(vertices: Tensor, faces: Tensor) -> Tensor:
    """The vertices [V, 3] of a mesh after a few rounds of Taubin's smoothing, which rounds its edges."""
    neighbours = joined(faces.numpy(), len(vertices))
    mean = diags_array(1 / np.maximum(neighbours.sum(1), 1)) @ neighbours
    mesh = trimesh.Trimesh(vertices.double().numpy(), faces.numpy(), process=False)
    filter_taubin(mesh, 0.5, 0.53, 2 * ROUNDS, mean)
    return torch.from_numpy(mesh.vertices.astype(np.float32))


@torch.no_grad()
def outer_surface(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices and faces of the visible surface of a shape [V, 3], [F, 3], without folds and self-intersections.

    A grid is carved by depth maps of 42 orthographic cameras: a cell in front of the shape in any of them is empty
    (Curless and Levoy 1996). Marching cubes and Taubin's smoothing follow. Normals point outwards.
    """
    low, high = vertices.amin(0), vertices.amax(0)
    centre, cell = (low + high) / 2, float((high - low).max()) / CELLS
    shape = vertices - centre
    reach = 1.05 * float(shape.norm(dim=1).max())
    eyes = F.normalize(nmr.icosphere(1)[0] + torch.tensor([0.013, 0.007, 0.011]), dim=1)  # along no axis
    cameras = nmr.Orthographic(4 * reach * eyes, scale=1 / reach)
    copies = shape.expand(len(eyes), -1, -1)
    depth = nmr.render_depth(copies, faces, cameras, image_size=DEPTH_SIDE, anti_aliasing=False)
    depth = -depth.clamp(max=8 * reach)
    for kernel, pad in (((7, 1), (3, 0)), ((1, 7), (0, 3))):  # grow by three pixels, about 1.3 cells
        depth = F.max_pool2d(depth, kernel, 1, pad)
    depth = -depth
    counts = [math.ceil(float(side) / 2 / cell) + _RIM for side in high - low]
    axes = [cell * torch.arange(-count, count + 1) for count in counts]
    axes = [axis.view([-1 if n == m else 1 for m in range(3)]) for n, axis in enumerate(axes)]
    frame = cameras.transform(torch.eye(4, 3).expand(len(eyes), -1, -1)).float()  # the axes and the origin
    outside = torch.full([2 * count + 1 for count in counts], -2.0 * cell)
    for image, (*steps, origin) in zip(depth, frame, strict=True):
        x, y, z = (
            origin[k] + sum(axis * (step[k] - origin[k]) for axis, step in zip(axes, steps, strict=True))
            for k in range(3)
        )
        column, row = (((value + 1) * (DEPTH_SIDE / 2)).long().clamp(0, DEPTH_SIDE - 1) for value in (x, -y))
        outside = torch.maximum(outside, (image[row, column] - z).clamp(max=2 * cell))
    field = gaussian_filter(outside.numpy(), 0.7)
    points, triangles, _, _ = marching_cubes(field, _GROWTH * cell, spacing=(cell,) * 3)
    points = torch.from_numpy(points.astype(np.float32)) + centre - cell * torch.tensor(counts)
    triangles = torch.from_numpy(triangles.astype(np.int64))
    points = smooth(points, triangles)
    return points - 0.7 * _GROWTH * cell * nmr.vertex_normals(points, triangles), triangles


def divide(vertices: Tensor, faces: Tensor, longest: float) -> tuple[Tensor, Tensor]:
    """Divide a mesh [V, 3], [F, 3] until no edge is longer than `longest`. Closed meshes stay closed.

    An edge is halved, and with it all its faces, if it is the longest of each of them (Rivara 1984).
    """
    points, triangles = vertices.double().numpy(), faces.numpy()
    while True:
        low, high = (f(triangles, np.roll(triangles, -1, 1)) for f in (np.minimum, np.maximum))
        keys, edge = np.unique(low * len(points) + high, return_inverse=True)
        edges, edge = np.stack(np.divmod(keys, len(points)), 1), edge.reshape(-1, 3)
        length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        rank = np.argsort(np.argsort(length, kind="stable"), kind="stable")  # no two are equal
        side = rank[edge].argmax(1)
        chosen = np.take_along_axis(edge, side[:, None], 1)[:, 0]
        halved = (length > longest) & (np.bincount(chosen, minlength=len(edges)) == np.bincount(edge.ravel()))
        if not halved.any():
            return torch.from_numpy(points.astype(np.float32)), torch.from_numpy(triangles)
        middle = len(points) + np.cumsum(halved) - 1
        points = np.concatenate([points, points[edges[halved]].mean(1)])
        rows = np.flatnonzero(halved[chosen])
        a, b, c = (triangles[rows, (side[rows] + k) % 3] for k in range(3))
        m = middle[chosen[rows]]
        triangles = np.delete(triangles, rows, 0)
        triangles = np.concatenate([triangles, np.stack([a, m, c], 1), np.stack([m, b, c], 1)])


def sharpen(surface: Surface, angle_deg: float = 40.0) -> Surface:
    """The surface with vertices doubled along edges of larger angles, so that normals there are not averaged."""
    mesh = trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)
    smooth = mesh.face_adjacency[mesh.face_adjacency_angles < math.radians(angle_deg)]
    patch = trimesh.graph.connected_component_labels(smooth, len(mesh.faces))
    corners = np.stack([mesh.faces.ravel(), np.repeat(patch, 3)], 1)
    kept, faces = np.unique(corners, axis=0, return_inverse=True)
    rows = torch.from_numpy(kept[:, 0].astype(np.int64))
    faces = torch.from_numpy(faces.reshape(-1, 3).astype(np.int64))
    return Surface(surface.vertices[rows], faces, surface.colors[rows])


def joined(faces: np.ndarray, count: int) -> coo_array:
    """Adjacency of `count` vertices by the edges of faces [F, 3]: a sparse matrix of zeros and ones, CSR."""
    rows, columns = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    edges = coo_array((np.ones(len(rows)), (rows, columns)), (count, count)).tocsr()
    return ((edges + edges.T) > 0).astype(np.float64)
