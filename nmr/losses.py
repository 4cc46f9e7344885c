"""Losses on silhouettes and meshes.

Most losses on meshes take ``edges = nmr.edge_table(faces)``, made once per mesh; those that do not
use faces also take :func:`nmr.unique_edges`, for any mesh.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from . import ops
from ._validate import check_indices, check_number, check_vertices, describe
from .mesh import face_normals, face_vertices

__all__ = [
    "area_loss",
    "edge_length_loss",
    "inflation_loss",
    "laplacian_loss",
    "normal_consistency_loss",
    "smoothness_loss",
    "soft_iou_loss",
    "volume_loss",
]


def soft_iou_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """One minus the mean soft intersection over union:
    ``1 - mean_b(sum(p t) / sum(p + t - p t))``.

    Parameters
    ----------
    prediction : float Tensor [B, ...], in [0, 1]
        One image needs its batch axis, ``image[None]``: the rows of ``[H, W]`` would count as H
        images.
    target : Tensor of the same shape, in [0, 1] (not 0..255), of any type

    Returns
    -------
    scalar Tensor, float64 if prediction is, else float32 (also for half precision)
        0 if all pairs are binary and equal. A pair of two empty images counts as equal (the
        published code returns NaN); its gradient is 0. Differentiable in both arguments, twice.

    Raises
    ------
    TypeError, ValueError
        If the shapes differ, the batch is empty, or the target is far outside [0, 1], as masks of
        0 and 255 are.

    Examples
    --------
    >>> target = torch.tensor([[0.0, 1.0, 1.0]])
    >>> nmr.losses.soft_iou_loss(torch.tensor([[0.5, 1.0, 0.0]]), target)
    tensor(0.6000)
    """
    if (
        not isinstance(prediction, Tensor)
        or not isinstance(target, Tensor)
        or not prediction.is_floating_point()
    ):
        raise TypeError(
            "prediction and target must be tensors, and prediction a float tensor, "
            f"got {describe(prediction)} and {describe(target)}"
        )
    if prediction.shape != target.shape or prediction.ndim < 2 or prediction.shape[0] == 0:
        raise ValueError(
            "prediction and target must have the same shape [B, ...] with B >= 1, "
            f"got {describe(prediction)} and {describe(target)}"
        )
    dtype = torch.float64 if prediction.dtype == torch.float64 else torch.float32
    prediction, target = prediction.to(dtype), target.to(dtype)
    forward_mode = not torch.compiler.is_compiling() and ops.in_forward_mode(prediction, target)
    if prediction.is_cpu and target.is_cpu and not forward_mode:
        return ops.soft_iou_loss(prediction, target)[0]
    return ops.soft_iou_in_torch(prediction, target)


def smoothness_loss(vertices: Tensor, edges: Tensor) -> Tensor:
    """How far neighbouring faces are from flat: mean over meshes of
    ``sum over edges (1 + cos(theta_e))^2``.

    The form is that of Kato et al. 2018; SoftRas calls it the flattening loss.

    theta_e is the angle between the two faces at edge e: pi (cos = -1) when flat. With
    ``a = v1 - v0`` along the edge and ``b = v_k - v0`` to an opposite corner, each face has the
    height ``h = b - a (a.b) / (|a|^2 + e)`` of length ``|b| sqrt(1 - cos(a, b)^2 + e)``, and
    ``cos(theta) = h.h' / (|h| |h'| + e)``, e = 1e-6 in every root and denominator.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    edges : int64 Tensor [E, 4] of :func:`nmr.edge_table`

    Returns
    -------
    scalar Tensor
        Differentiable once in ``vertices``.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and for edges that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> edges = nmr.edge_table(faces)
    >>> nmr.losses.smoothness_loss(vertices, edges)
    """
    vertices = _check_meshes(vertices)
    return ops.smoothness(vertices, _check_edge_table(edges).to(vertices.device)).mean()


def laplacian_loss(vertices: Tensor, edges: Tensor) -> Tensor:
    """How far the vertices are from the mean of their neighbours: mean over meshes of
    ``sum_i |v_i - mean_j v_j|^2``.

    j runs over the vertices that share an edge with i: the uniform Laplacian. This is the
    published form of SoftRas and of Kato and Harada 2019; PyTorch3D takes the mean of the lengths
    instead.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    edges : int64 Tensor [E, 2] of :func:`nmr.unique_edges`, or [E, 4] of :func:`nmr.edge_table`

    Returns
    -------
    scalar Tensor
        Differentiable in ``vertices``. Vertices without edges contribute 0.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and for edges that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> edges = nmr.unique_edges(faces)
    >>> nmr.losses.laplacian_loss(vertices, edges)
    """
    vertices = _check_meshes(vertices)
    v0, v1 = _check_edges(edges, vertices)
    rows = _batch_last(vertices)
    difference = rows.index_select(0, v1) - rows.index_select(0, v0)
    sums = (
        torch.zeros_like(rows).index_add(0, v0, difference).index_add(0, v1, difference, alpha=-1)
    )
    one = vertices.new_ones(len(v0))
    degree = vertices.new_zeros(len(rows)).index_add(0, v0, one).index_add(0, v1, one)
    return (sums / degree.clamp_min(1)[:, None, None]).square().sum((0, 1)).mean()


def edge_length_loss(vertices: Tensor, edges: Tensor, target: float | None = None) -> Tensor:
    """How much the edges differ in length: mean over meshes of
    ``sum over edges (|v1 - v0| - target)^2``.

    Kato and Harada's 2019 code counts an edge once for each of its faces: on a closed mesh that
    is twice this loss. PyTorch3D takes the mean over the edges instead of the sum.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    edges : int64 Tensor [E, 2] of :func:`nmr.unique_edges`, or [E, 4] of :func:`nmr.edge_table`
    target : float, optional
        The length to reach, in the unit of the vertices; by default the mean length of each
        mesh's own edges.

    Returns
    -------
    scalar Tensor
        Differentiable in ``vertices``; an edge of length 0 has no gradient.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, for edges that refer to missing vertices, and for a target
        that is negative or not finite.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> edges = nmr.unique_edges(faces)
    >>> nmr.losses.edge_length_loss(vertices, edges)
    """
    vertices = _check_meshes(vertices)
    v0, v1 = _check_edges(edges, vertices)
    if target is not None and not (0 <= check_number(target, "target") < math.inf):
        raise ValueError(
            f"target must be a finite length >= 0, got {target}; leave it out for the mean length"
        )
    rows = _batch_last(vertices)
    length = _length(rows.index_select(0, v1) - rows.index_select(0, v0))
    goal = length.mean(0) if target is None else target
    return (length - goal).square().sum(0).mean()


def normal_consistency_loss(vertices: Tensor, edges: Tensor) -> Tensor:
    """How much neighbouring faces differ in direction: mean over meshes and edges of
    ``1 - cos(n, n')``.

    n and n' are the normals of the two faces at an edge, both on the same side of the surface:
    the order of the faces' vertices does not matter. 0 when flat. This is PyTorch3D's definition
    (``mesh_normal_consistency``) for meshes whose edges have one face or two.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    edges : int64 Tensor [E, 4] of :func:`nmr.edge_table`, E >= 1

    Returns
    -------
    scalar Tensor
        Differentiable in ``vertices``. An edge at a face without area contributes 1 and has no
        gradient.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and for edges that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> edges = nmr.edge_table(faces)
    >>> nmr.losses.normal_consistency_loss(vertices, edges)
    """
    vertices = _check_meshes(vertices)
    edges = _check_edge_table(edges).to(vertices.device)
    if len(edges) == 0:
        raise ValueError("edges must hold at least one edge, got int64 [0, 4]")
    check_indices(edges, vertices.shape[1], "edges")
    rows = _batch_last(vertices)
    origin, end, left, right = (rows.index_select(0, column) for column in edges.unbind(1))
    normal = _of_size_one(_cross(end - origin, left - origin))
    other = _of_size_one(_cross(right - origin, end - origin))
    lengths = _length(normal) * _length(other)
    flat = lengths == 0
    cos = (normal * other).sum(1) / torch.where(flat, 1.0, lengths)
    return (1 - torch.where(flat, 0.0, cos)).mean()


def inflation_loss(vertices: Tensor, faces: Tensor) -> Tensor:
    """A pressure from inside: mean over meshes of
    ``sum over faces f and their corners k |v_k + n_f - v_k|``.

    For the gradient, the first v_k and the unit normal n_f are constants. The value is therefore
    3 for every face. The gradient is ``-n_f`` at each corner, so that gradient descent moves
    every vertex outwards. From the code of Kato and Harada 2019 (view prior learning).

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    faces : integer Tensor [F, 3] or [B, F, 3], counter-clockwise seen from outside

    Returns
    -------
    scalar Tensor
        Its gradient in ``vertices`` is the one above, not the derivative of the value. Faces
        without area contribute 0.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and for faces that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> nmr.losses.inflation_loss(vertices, faces)  # 3840
    """
    vertices = _check_meshes(vertices)
    corners = face_vertices(vertices, faces)
    moved = corners.detach() + face_normals(vertices.detach(), faces).unsqueeze(2)
    return torch.linalg.vector_norm(moved - corners, dim=-1).sum((1, 2)).mean()


def area_loss(vertices: Tensor, faces: Tensor) -> Tensor:
    """The area of surfaces: mean over meshes of ``sum over faces |(v1 - v0) x (v2 - v0)| / 2``.

    Among the shapes that match given silhouettes, a small weight on the area selects one without
    folds, flat on the sides that no camera sees.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    faces : integer Tensor [F, 3] or [B, F, 3]

    Returns
    -------
    scalar Tensor
        Differentiable in ``vertices``; the gradient of a face without area is 0.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and for faces that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> nmr.losses.area_loss(vertices, faces)  # 12.51, the unit sphere has 12.57
    """
    v0, v1, v2 = face_vertices(_check_meshes(vertices), faces).unbind(2)
    return torch.linalg.vector_norm(torch.linalg.cross(v1 - v0, v2 - v0), dim=-1).sum(1).mean() / 2


def volume_loss(vertices: Tensor, faces: Tensor) -> Tensor:
    """The volume that closed surfaces enclose: mean over meshes of
    ``sum over faces v0 . (v1 x v2) / 6``.

    Of the shapes that agree with given silhouettes, the visual hull is the largest. A small
    weight on the volume removes parts that no silhouette needs, such as the filling between a
    seat and its legs.

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    faces : integer Tensor [F, 3] or [B, F, 3], counter-clockwise seen from outside

    Returns
    -------
    scalar Tensor
        Differentiable in ``vertices``. Negative if a surface is turned inside out. It does not
        depend on the place of a mesh if the surface is closed.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, and for faces that refer to missing vertices.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> nmr.losses.volume_loss(vertices, faces)  # 4.151, the unit ball has 4.189
    """
    v0, v1, v2 = face_vertices(_check_meshes(vertices), faces).unbind(2)
    return (v0 * torch.linalg.cross(v1, v2)).sum((1, 2)).mean() / 6


def _batch_last(vertices: Tensor) -> Tensor:
    """[B, V, 3] as [V, 3, B]: long rows are copied and summed at the speed of memory."""
    return vertices.permute(1, 2, 0).contiguous()


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross products of vectors [N, 3, B]."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(1), b.unbind(1)
    return torch.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], dim=1)


def _of_size_one(vectors: Tensor) -> Tensor:
    """Vectors [N, 3, B] with a largest coordinate of 1, so that their squares neither under- nor
    overflow; those of length 0 stay. The factor is a constant for the gradient.
    """
    size = vectors.detach().abs().amax(1, keepdim=True)
    return vectors / torch.where(size < torch.finfo(size.dtype).tiny, 1.0, size)


def _length(vectors: Tensor) -> Tensor:
    """Lengths [N, B] of vectors [N, 3, B]; the gradient of a length 0 is 0."""
    square = vectors.square().sum(1)
    zero = square == 0
    return torch.where(zero, 0.0, torch.where(zero, 1.0, square).sqrt())


def _check_meshes(vertices: object) -> Tensor:
    """``vertices`` as [B, V, 3], B >= 1."""
    vertices = check_vertices(vertices)
    if vertices.shape[0] == 0:
        raise ValueError(f"vertices must hold at least one mesh, got {describe(vertices)}")
    return vertices


def _check_edge_table(edges: object) -> Tensor:
    if (
        not isinstance(edges, Tensor)
        or edges.dtype != torch.int64
        or edges.ndim != 2
        or edges.shape[1] != 4
    ):
        raise ValueError(
            f"edges must be an int64 tensor [E, 4] as made by nmr.edge_table(faces), got {describe(edges)}"
        )
    return edges


def _check_edges(edges: object, vertices: Tensor) -> tuple[Tensor, Tensor]:
    """First and second vertices of the edges, [E] each, on the device of the vertices."""
    if (
        not isinstance(edges, Tensor)
        or edges.dtype != torch.int64
        or edges.ndim != 2
        or edges.shape[1] not in (2, 4)
    ):
        raise ValueError(
            "edges must be an int64 tensor [E, 2] or [E, 4] as made by nmr.unique_edges(faces) or "
            f"nmr.edge_table(faces), got {describe(edges)}"
        )
    edges = edges[:, :2].to(vertices.device)
    check_indices(edges, vertices.shape[1], "edges")
    return edges[:, 0], edges[:, 1]
