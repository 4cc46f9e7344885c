"""Mesh topology: the sphere to deform, and which faces meet at which edge."""

from __future__ import annotations

import torch
from torch import Tensor

from ._validate import check_faces


def icosphere(subdivisions: int = 3) -> tuple[Tensor, Tensor]:
    """A unit sphere of 10 * 4^n + 2 vertices and 20 * 4^n faces: a subdivided icosahedron (n = 3: 642 and 1280).

    Returns
    -------
    vertices : float32 [V, 3], of length 1
    faces : int64 [F, 3], counter-clockwise seen from outside

    Raises
    ------
    ValueError
        If subdivisions is not in 0..7.
    """
    if not 0 <= subdivisions <= 7:
        raise ValueError(f"subdivisions must lie in 0..7, got {subdivisions}")
    t = (1 + 5**0.5) / 2
    corners = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0)]
    corners += [(z, x, y) for x, y, z in corners[:4]] + [(y, z, x) for x, y, z in corners[:4]]
    vertices = torch.tensor(corners, dtype=torch.float64)
    # The 20 triples of mutually nearest corners (distance 2), wound outwards.
    near = torch.cdist(vertices, vertices) < 2.1
    faces = torch.tensor(
        [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]]
    )
    a, b, c = vertices[faces].unbind(1)
    inward = (torch.linalg.cross(b - a, c - a) * a).sum(1) < 0
    faces[inward] = faces[inward].flip(1)
    vertices = vertices / vertices.norm(dim=1, keepdim=True)
    for _ in range(subdivisions):
        pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
        pairs, edge = torch.unique(pairs, dim=0, return_inverse=True)
        ab, bc, ca = (edge + len(vertices)).view(3, -1).unbind(0)
        a, b, c = faces.unbind(1)
        midpoints = vertices[pairs].sum(1)
        vertices = torch.cat([vertices, midpoints / midpoints.norm(dim=1, keepdim=True)])
        faces = torch.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], dim=1).view(-1, 3)
    return vertices.float(), faces


def edge_table(faces: Tensor) -> Tensor:
    """Every edge of a closed mesh with the two faces that share it.

    Parameters
    ----------
    faces : integer Tensor [F, 3]

    Returns
    -------
    int64 Tensor [E, 4]
        Row ``(v0, v1, v2, v3)``: the edge's vertices with v0 < v1, then the opposite corners of its two faces (in
        face order). Rows are sorted by (v0, v1).

    Raises
    ------
    TypeError, ValueError
        For a wrong type or shape, and for a mesh with an edge that does not have exactly two faces (a boundary, a
        non-manifold edge or a degenerate face): the message says how many edges and names the first.
    """
    faces = check_faces(faces, 1, torch.device("cpu"))
    if faces.ndim != 2:
        raise ValueError(f"faces must have shape [F, 3], got {list(faces.shape)}; pass the faces of one mesh")
    # Sides 0-1, 1-2 and 2-0 with their opposite corners, grouped by edge; a stable sort keeps the face order.
    sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    opposite = torch.cat([faces[:, 2], faces[:, 0], faces[:, 1]])
    face = torch.arange(len(faces)).repeat(3)
    order = torch.argsort(face, stable=True)
    sides, opposite = sides[order], opposite[order]
    edges, edge_of_side, counts = torch.unique(sides, dim=0, return_inverse=True, return_counts=True)
    bad = torch.nonzero(counts != 2).flatten()
    if len(bad):
        v0, v1 = edges[bad[0]].tolist()
        raise ValueError(
            f"every edge must have exactly two faces (a closed mesh), but {len(bad)} of {len(edges)} have not: "
            f"edge ({v0}, {v1}) has {int(counts[bad[0]])}; "
            "close the mesh first (for example with trimesh.repair.fill_holes)"
        )
    order = torch.argsort(edge_of_side, stable=True)
    return torch.cat([edges, opposite[order].view(-1, 2)], dim=1)
