"""Finer, smoother meshes: divided edges, and the outer surface of meshes that cross themselves."""

import numpy as np
import torch
import torch.nn.functional as F
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array, diags_array
from torch import Tensor
from trimesh.smoothing import filter_taubin

import nmr
from learn3d.pictures import grid_surface

RESOLUTION = 128  # cells along each side of the grid of `outer_surface`
_LEVEL = 0.15  # share of a cell that is filled at the surface
_SHRINKAGE = 0.8  # cells by which the surface is moved inwards


def smooth(vertices: Tensor, faces: Tensor, rounds: int = 4) -> Tensor:
    """The vertices [V, 3] of a mesh after Taubin's smoothing, which rounds its edges.

    Each round shrinks the mesh and grows it again.
    """
    neighbours = joined(faces.numpy(), len(vertices))
    mean = diags_array(1 / np.maximum(neighbours.sum(1), 1)) @ neighbours
    mesh = trimesh.Trimesh(vertices.double().numpy(), faces.numpy(), process=False)
    filter_taubin(mesh, 0.5, 0.53, 2 * rounds, mean)
    return torch.from_numpy(mesh.vertices.astype(np.float32))


@torch.no_grad()
def outer_surface(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices and faces of the visible surface of a shape [V, 3], [F, 3], without folds and self-intersections.

    It encloses the cells of a grid that cannot be reached from outside (`nmr.voxelize`). To keep
    thin parts whole, the surface is first drawn too far outside, smoothed, and then moved
    inwards. Normals point outwards.
    """
    low, high = vertices.amin(0), vertices.amax(0)
    centre, side = (low + high) / 2, 1.1 * float((high - low).max())
    solid = nmr.voxelize((vertices - centre) / side + 0.5, faces, size=2 * RESOLUTION)
    share = gaussian_filter(F.avg_pool3d(solid.float(), 2)[0].numpy(), 0.7)
    points, triangles, *_ = grid_surface(torch.from_numpy(share), level=_LEVEL, box=side)
    points = smooth(points, triangles, rounds=12)
    return points + centre - _SHRINKAGE * side / RESOLUTION * nmr.vertex_normals(
        points, triangles
    ), triangles


def divide(vertices: Tensor, faces: Tensor, longest: float) -> tuple[Tensor, Tensor]:
    """Divide a mesh [V, 3], [F, 3] until no edge is longer than `longest`. Closed meshes stay closed.

    Vertices [V, 3 + C] have C further values, which are interpolated.

    An edge is halved, and with it all its faces, if it is the longest of each of them (Rivara
    1984).
    """
    points, triangles = vertices.double().numpy(), faces.numpy()
    while True:
        low, high = (f(triangles, np.roll(triangles, -1, 1)) for f in (np.minimum, np.maximum))
        keys, edge = np.unique(low * len(points) + high, return_inverse=True)
        edges, edge = np.stack(np.divmod(keys, len(points)), 1), edge.reshape(-1, 3)
        length = np.linalg.norm((points[edges[:, 0]] - points[edges[:, 1]])[:, :3], axis=1)
        rank = np.argsort(np.argsort(length, kind="stable"), kind="stable")  # no two are equal
        side = rank[edge].argmax(1)
        chosen = np.take_along_axis(edge, side[:, None], 1)[:, 0]
        halved = (length > longest) & (
            np.bincount(chosen, minlength=len(edges)) == np.bincount(edge.ravel())
        )
        if not halved.any():
            return torch.from_numpy(points.astype(np.float32)), torch.from_numpy(triangles)
        middle = len(points) + np.cumsum(halved) - 1
        points = np.concatenate([points, points[edges[halved]].mean(1)])
        rows = np.flatnonzero(halved[chosen])
        a, b, c = (triangles[rows, (side[rows] + k) % 3] for k in range(3))
        m = middle[chosen[rows]]
        triangles = np.delete(triangles, rows, 0)
        triangles = np.concatenate([triangles, np.stack([a, m, c], 1), np.stack([m, b, c], 1)])


def joined(faces: np.ndarray, count: int) -> coo_array:
    """Adjacency of `count` vertices by the edges of faces [F, 3]: a sparse matrix of zeros and ones, CSR."""
    rows, columns = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    edges = coo_array((np.ones(len(rows)), (rows, columns)), (count, count)).tocsr()
    return ((edges + edges.T) > 0).astype(np.float64)
