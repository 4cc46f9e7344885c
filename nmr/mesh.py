"""Meshes: spheres, tables of edges, normals."""

from __future__ import annotations

import torch
from torch import Tensor

from . import ops
from ._validate import check_faces, check_indices, check_vertices, describe
from ._vectors import gather_rows


def icosphere(subdivisions: int = 3) -> tuple[Tensor, Tensor]:
    """A unit sphere of 10 * 4^n + 2 vertices and 20 * 4^n faces: a subdivided icosahedron (n = 3:
    642 and 1280).

    Returns
    -------
    vertices : float32 [V, 3], of length 1, on the default device
    faces : int64 [F, 3], counter-clockwise seen from outside

    Raises
    ------
    TypeError, ValueError
        If subdivisions is not an integer in 0..7.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> vertices.shape, faces.shape
    (torch.Size([642, 3]), torch.Size([1280, 3]))
    """
    if not hasattr(subdivisions, "__index__"):
        raise TypeError(f"subdivisions must be an integer, got {describe(subdivisions)}")
    if not 0 <= subdivisions <= 7:
        raise ValueError(f"subdivisions must lie in 0..7, got {subdivisions}")
    t = (1 + 5**0.5) / 2
    corners = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0)]
    corners += [(z, x, y) for x, y, z in corners[:4]] + [(y, z, x) for x, y, z in corners[:4]]
    vertices = torch.tensor(corners, dtype=torch.float64, device="cpu")
    # The 20 triples of mutually nearest corners (distance 2), wound outwards.
    near = torch.cdist(vertices, vertices) < 2.1
    faces = torch.tensor(
        [
            (i, j, k)
            for i in range(12)
            for j in range(i)
            for k in range(j)
            if near[i, j] and near[j, k] and near[i, k]
        ],
        device="cpu",
    )
    a, b, c = vertices[faces].unbind(1)
    inward = (torch.linalg.cross(b - a, c - a) * a).sum(1) < 0
    faces[inward] = faces[inward].flip(1)
    vertices = vertices / vertices.norm(dim=1, keepdim=True)
    for _ in range(subdivisions):
        pairs, edge = torch.unique(_sides(faces), dim=0, return_inverse=True)
        ab, bc, ca = (edge + len(vertices)).view(3, -1).unbind(0)
        a, b, c = faces.unbind(1)
        midpoints = vertices[pairs].sum(1)
        vertices = torch.cat([vertices, midpoints / midpoints.norm(dim=1, keepdim=True)])
        faces = torch.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], dim=1).view(-1, 3)
    device = torch.empty(0).device
    return vertices.to(device, torch.float32), faces.to(device)


def unique_edges(faces: Tensor) -> Tensor:
    """Every edge of a mesh once. The mesh may have borders, and edges with more than two faces.

    Parameters
    ----------
    faces : integer Tensor [F, 3]

    Returns
    -------
    int64 Tensor [E, 2]
        Row ``(v0, v1)``: an edge, v0 < v1. Rows are sorted. A side from a vertex to itself is no
        edge.

    Raises
    ------
    TypeError, ValueError
        For a wrong type or shape.

    Examples
    --------
    >>> _, faces = nmr.icosphere(3)
    >>> nmr.unique_edges(faces).shape
    torch.Size([1920, 2])
    """
    sides = _sides(_one_mesh(faces))
    return torch.unique(sides[sides[:, 0] != sides[:, 1]], dim=0)


def edge_table(faces: Tensor, *, open_mesh: bool = False) -> Tensor:
    """Every edge with the two faces that share it.

    Parameters
    ----------
    faces : integer Tensor [F, 3]
    open_mesh : bool
        Leave out border edges, which have one face; else they are an error.

    Returns
    -------
    int64 Tensor [E, 4]
        Row ``(v0, v1, v2, v3)``: the edge's vertices, v0 < v1, then the opposite corners of its two
        faces (in face order). Rows are sorted.

    Raises
    ------
    TypeError, ValueError
        For a wrong type or shape, and an edge without exactly two faces (a border, unless
        `open_mesh`; a non-manifold edge or a degenerate face); the message names the first.

    Examples
    --------
    >>> square = torch.tensor([[0, 1, 2], [0, 2, 3]])
    >>> nmr.edge_table(square, open_mesh=True)
    tensor([[0, 2, 1, 3]])
    """
    faces = _one_mesh(faces)
    # Sides 0-1, 1-2 and 2-0 with their opposite corners, grouped by edge; a stable sort keeps the
    # face order.
    opposite = torch.cat([faces[:, 2], faces[:, 0], faces[:, 1]])
    order = torch.argsort(torch.arange(len(faces), device="cpu").repeat(3), stable=True)
    sides, opposite = _sides(faces)[order], opposite[order]
    edges, edge_of_side, counts = torch.unique(
        sides, dim=0, return_inverse=True, return_counts=True
    )
    if open_mesh:
        wrong, wanted = counts > 2, "at most two faces"
    else:
        wrong, wanted = counts != 2, "exactly two faces (a closed mesh)"
    bad = torch.nonzero(wrong | (edges[:, 0] == edges[:, 1])).flatten()
    if len(bad):
        v0, v1 = edges[bad[0]].tolist()
        remedy = "close the mesh first (for example with trimesh.repair.fill_holes) or pass open_mesh=True"
        if v0 == v1 or counts[bad[0]] > 2:
            remedy = "remove the extra faces, and faces that use a vertex twice"
        raise ValueError(
            f"every edge must have two different vertices and {wanted}, but {len(bad)} of {len(edges)} edges do not: "
            f"edge ({v0}, {v1}) has {int(counts[bad[0]])} face(s); {remedy}"
        )
    inner = counts[edge_of_side] == 2
    order = torch.argsort(edge_of_side[inner], stable=True)
    return torch.cat([edges[counts == 2], opposite[inner][order].view(-1, 2)], dim=1)


def face_vertices(vertices: Tensor, faces: Tensor) -> Tensor:
    """The corners of every face, ``[B, F, 3 corners, 3]`` (``[F, 3, 3]`` for vertices
    ``[V, 3]``).

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    faces : integer Tensor [F, 3] or [B, F, 3]

    Returns
    -------
    Tensor
        ``face_vertices[b, f, k]`` is vertex ``faces[f, k]`` of mesh b. Differentiable in
        ``vertices``.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and missing vertices of faces.
    """
    batched = check_vertices(vertices)
    faces = check_faces(faces, batched.shape[0], batched.device)
    check_indices(faces, batched.shape[1])
    corners = gather_rows(batched, faces.flatten(-2)).unflatten(1, (-1, 3))
    return corners if vertices.ndim == 3 else corners.squeeze(0)


def face_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals of the faces: ``(p1 - p0) x (p2 - p0)``, normalised, p0, p1, p2 the face's
    corners in order.

    Those of counter-clockwise faces of a right-handed world point outwards.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    faces : integer Tensor [F, 3] or [B, F, 3]

    Returns
    -------
    Tensor [B, F, 3], or [F, 3] for vertices [V, 3]
        Of length 1; 0, without gradient, for a face without area. Differentiable in ``vertices``.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and missing vertices of faces.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> nmr.face_normals(vertices, faces).shape
    torch.Size([1280, 3])
    """
    return _normals(vertices, faces, smooth=False)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals at the vertices: the normals of the faces around each, weighted by their
    areas, normalised.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    faces : integer Tensor [F, 3] or [B, F, 3]

    Returns
    -------
    Tensor like vertices
        Of length 1; 0 at a vertex that no face with an area touches. Differentiable in
        ``vertices``.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and missing vertices of faces.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> (nmr.vertex_normals(vertices, faces) * vertices).sum(-1).min() > 0.999
    tensor(True)
    """
    return _normals(vertices, faces, smooth=True)


def _normals(vertices: Tensor, faces: Tensor, smooth: bool) -> Tensor:
    batched = check_vertices(vertices)
    faces = check_faces(faces, batched.shape[0], batched.device)
    # the kernel's normals belong to clockwise faces
    normals = ops.normals(batched, faces.flip(-1), None, smooth)
    return normals if vertices.ndim == 3 else normals.squeeze(0)


def _one_mesh(faces: Tensor) -> Tensor:
    """``faces`` as int64 [F, 3] in host memory."""
    faces = check_faces(faces, 1, torch.device("cpu"))
    if faces.ndim != 2:
        raise ValueError(
            f"faces must have shape [F, 3], got {list(faces.shape)}; pass the faces of one mesh"
        )
    return faces


def _sides(faces: Tensor) -> Tensor:
    """Vertices of all sides 0-1, then all 1-2, then all 2-0, [3 F, 2], the smaller first."""
    return torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
