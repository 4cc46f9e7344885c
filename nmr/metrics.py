"""How close two shapes are: points on surfaces, Chamfer distance, F-score, IoU of grids.

SciPy's k-d tree finds nearest points if SciPy is installed and the points are in host memory, else
all pairs are compared in chunks (0.3 s, not 7 ms, for 10,000 and 10,000 points on two cores). Both
are exact, and may differ among equally near points.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ._clip import can_read
from ._validate import cast_under_autocast, check_number, check_size, check_vertices, describe
from ._vectors import face_cross, gather_rows, unit
from .mesh import face_vertices

__all__ = [
    "SurfacePoints",
    "chamfer_distance",
    "f_score",
    "sample_surface",
    "voxel_iou",
    "voxel_precision_recall",
]

_CHUNK = 1 << 19  # distances held in memory at once, without SciPy


class SurfacePoints(NamedTuple):
    """Points on the surfaces of meshes; without the leading B for vertices [V, 3]."""

    points: Tensor  # [B, N, 3], differentiable in the vertices
    normals: Tensor  # [B, N, 3], normals of their faces; differentiable
    face_index: Tensor  # int64 [B, N], their faces


def sample_surface(
    vertices: Tensor, faces: Tensor, count: int, generator: torch.Generator | None = None
) -> SurfacePoints:
    """Random points on meshes, uniform over their area.

    A face is drawn with probability proportional to its area, then a point on it, p = (1 - r)
    p0 + r (1 - s) p1 + r s p2 with r^2 and s uniform in [0, 1].

    Parameters
    ----------
    vertices : Tensor [B, V, 3] or [V, 3], float32 or float64
    faces : integer Tensor [F, 3] or [B, F, 3]
    count : int
        N, points per mesh.
    generator : torch.Generator, optional
        Source of the random numbers, on the device of the vertices; by default torch's global
        generator.

    Returns
    -------
    SurfacePoints (points, normals, face_index)
        ``points[b, n]`` is on face ``face_index[b, n]`` of mesh b, whose unit normal is
        ``normals[b, n]``. points and normals are differentiable in ``vertices``; which faces are
        drawn is not.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, faces that refer to missing vertices, and a mesh without area.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> points, normals, face_index = nmr.metrics.sample_surface(vertices, faces, 1000)
    >>> points.shape
    torch.Size([1000, 3])
    """
    count = check_size(count, "count", 1 << 30)
    batched = check_vertices(vertices)
    corners = face_vertices(batched, faces)
    cross = face_cross(corners)
    area = torch.linalg.vector_norm(cross.detach().double(), dim=-1)
    total = area.sum(1)
    known = total.isfinite() & (total > 0)
    if can_read() and not known.all():
        bad = int((~known).nonzero()[0])
        raise ValueError(f"every mesh must have a finite area above 0, mesh {bad} does not")
    face_index = torch.multinomial(area, count, replacement=True, generator=generator)
    random = torch.rand(
        2, *face_index.shape, 1, generator=generator, dtype=batched.dtype, device=batched.device
    )
    r, s = random[0].sqrt(), random[1]
    p0, p1, p2 = (gather_rows(corner, face_index) for corner in corners.unbind(2))
    points = (1 - r) * p0 + r * (1 - s) * p1 + r * s * p2
    normals = unit(gather_rows(cross, face_index))
    if vertices.ndim == 2:
        return SurfacePoints(points.squeeze(0), normals.squeeze(0), face_index.squeeze(0))
    return SurfacePoints(points, normals, face_index)


def chamfer_distance(
    points_a: Tensor, points_b: Tensor, form: Literal["squared", "l1"] = "squared"
) -> Tensor:
    """How far two sets of points are from each other, in both directions.

    With ``d(x, Y) = min_{y in Y} |x - y|``:

    - "squared": ``mean_a d(a, B)^2 + mean_b d(b, A)^2``, the usual loss (PyTorch3D's default);
    - "l1": ``(mean_a d(a, B) + mean_b d(b, A)) / 2``, the "Chamfer-L1" of Occupancy Networks: mean of accuracy and
      completeness, in the unit of the points. (Despite its name it uses Euclidean distances.)

    Parameters
    ----------
    points_a : Tensor [B, N, 3] or [N, 3], float32 or float64
    points_b : Tensor [B, M, 3] or [M, 3], of the same type
    form : "squared" or "l1"

    Returns
    -------
    Tensor [B], or a scalar for points [N, 3]
        Differentiable in both sets: each point is pulled to its nearest one (the gradient is 0 at
        distance 0).

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, empty sets, coordinates that are not finite, and an unknown
        form.

    Examples
    --------
    >>> a = nmr.metrics.sample_surface(*nmr.icosphere(3), 10000).points
    >>> b = nmr.metrics.sample_surface(*nmr.icosphere(2), 10000).points
    >>> nmr.metrics.chamfer_distance(a, b, "l1")
    """
    if form not in ("squared", "l1"):
        raise ValueError(f"form must be 'squared' or 'l1', got {form!r}")
    a, b = _check_points(points_a, points_b)
    ab, ba = _to_nearest(a, b), _to_nearest(b, a)
    if form == "squared":
        distance = ab.square().sum(-1).mean(1) + ba.square().sum(-1).mean(1)
    else:
        distance = (_length(ab).mean(1) + _length(ba).mean(1)) / 2
    return distance if points_a.ndim == 3 else distance.squeeze(0)


@torch.no_grad()
def f_score(points_a: Tensor, points_b: Tensor, threshold: float) -> Tensor:
    """Share of points that are close to the other set: ``2 P R / (P + R)`` with precision P and
    recall R.

    P is the share of the points a that are nearer than the threshold to some b, R the share of
    the points b that are nearer than the threshold to some a (Tatarchenko et al. 2019).

    Parameters
    ----------
    points_a : Tensor [B, N, 3] or [N, 3], float32 or float64
    points_b : Tensor [B, M, 3] or [M, 3], of the same type
    threshold : float
        In the unit of the points; often 1 % of the side of the bounding box.

    Returns
    -------
    Tensor [B], or a scalar for points [N, 3]
        From 0 (no point is near) to 1. Not differentiable.

    Raises
    ------
    TypeError, ValueError
        For wrong types and shapes, empty sets, coordinates that are not finite, and a threshold
        that is not above 0.

    Examples
    --------
    >>> a = nmr.metrics.sample_surface(*nmr.icosphere(3), 10000).points
    >>> b = nmr.metrics.sample_surface(*nmr.icosphere(2), 10000).points
    >>> nmr.metrics.f_score(a, b, 0.02)
    """
    if not check_number(threshold, "threshold") > 0:
        raise ValueError(f"threshold must be a distance above 0, got {threshold}")
    a, b = _check_points(points_a, points_b)
    precision = (_length(_to_nearest(a, b)) < threshold).to(a.dtype).mean(1)
    recall = (_length(_to_nearest(b, a)) < threshold).to(a.dtype).mean(1)
    score = 2 * precision * recall / (precision + recall).clamp_min(torch.finfo(a.dtype).tiny)
    return score if points_a.ndim == 3 else score.squeeze(0)


def voxel_iou(prediction: Tensor, target: Tensor) -> Tensor:
    """Intersection over union of occupancy grids.

    Parameters
    ----------
    prediction, target : bool Tensor [B, ...], of one shape, as made by :func:`nmr.voxelize`

    Returns
    -------
    float64 Tensor [B]
        NaN if both grids are empty.

    Raises
    ------
    TypeError, ValueError
        If they are not bool tensors, or their shapes differ.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> a, b = (nmr.voxelize(r * vertices + 0.5, faces) for r in (0.3, 0.4))
    >>> nmr.metrics.voxel_iou(a, b)  # about (3 / 4)^3
    """
    _check_grids(prediction, target)
    both = _count(prediction & target)
    return both / (_count(prediction) + _count(target) - both)


def voxel_precision_recall(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Precision and recall of predicted grids: the share of A that is in B, and the share of B
    that is in A.

    Shapes that are too full have a low precision, those that lack parts a low recall.

    Parameters
    ----------
    prediction, target : bool Tensor [B, ...], of one shape, as made by :func:`nmr.voxelize`

    Returns
    -------
    precision, recall : float64 Tensor [B] each
        ``|A & B| / |A|`` and ``|A & B| / |B|`` of prediction A and target B; NaN if A, or B, is
        empty.

    Raises
    ------
    TypeError, ValueError
        If they are not bool tensors, or their shapes differ.

    Examples
    --------
    >>> vertices, faces = nmr.icosphere(3)
    >>> a, b = (nmr.voxelize(r * vertices + 0.5, faces) for r in (0.4, 0.3))
    >>> nmr.metrics.voxel_precision_recall(a, b)  # about (3 / 4)^3, and 1
    """
    _check_grids(prediction, target)
    both = _count(prediction & target)
    return both / _count(prediction), both / _count(target)


def _check_grids(prediction: Tensor, target: Tensor) -> None:
    for grid in (prediction, target):
        if not isinstance(grid, Tensor) or grid.dtype != torch.bool:
            raise TypeError(
                "prediction and target must be bool tensors [B, ...], "
                f"got {describe(prediction)} and {describe(target)}; compare with a threshold first"
            )
    if prediction.shape != target.shape or prediction.ndim < 2:
        raise ValueError(
            "prediction and target must have the same shape [B, ...], "
            f"got {describe(prediction)} and {describe(target)}"
        )


def _count(grids: Tensor) -> Tensor:
    """Number of set cells of each grid, float64 [B]. NumPy counts bytes fifty times as fast as
    torch.
    """
    counts = [np.count_nonzero(grid) for grid in grids.flatten(1).cpu().numpy()]
    return torch.tensor(counts, dtype=torch.float64, device=grids.device)


def _check_points(a: object, b: object) -> tuple[Tensor, Tensor]:
    """Both sets as [B, N, 3]."""
    a, b = cast_under_autocast(a), cast_under_autocast(b)
    for points in (a, b):
        if not isinstance(points, Tensor) or points.dtype not in (torch.float32, torch.float64):
            raise TypeError(
                "points_a and points_b must be float32 or float64 tensors [B, N, 3] or [N, 3], "
                f"got {describe(a)} and {describe(b)}"
            )
    if (
        a.dtype != b.dtype
        or a.ndim not in (2, 3)
        or a.ndim != b.ndim
        or (a.shape[-1], b.shape[-1]) != (3, 3)
        or a.shape[:-2] != b.shape[:-2]
        or 0 in (a.numel(), b.numel())
    ):
        raise ValueError(
            "points_a and points_b must be [B, N, 3] and [B, M, 3], or [N, 3] and [M, 3], with the same dtype and at "
            f"least one point each, got {describe(a)} and {describe(b)}"
        )
    if can_read() and not (a.isfinite().all() and b.isfinite().all()):
        raise ValueError(
            "points_a and points_b must be finite, but have coordinates that are infinite or NaN"
        )
    return (a, b) if a.ndim == 3 else (a.unsqueeze(0), b.unsqueeze(0))


def _to_nearest(a: Tensor, b: Tensor) -> Tensor:
    """Vectors from each point of a [B, N, 3] to its nearest point of b [B, M, 3]. Differentiable
    in both.
    """
    return gather_rows(b, _nearest(a.detach(), b.detach())) - a


def _length(vectors: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vectors, dim=-1)


def _nearest(a: Tensor, b: Tensor) -> Tensor:
    """Index [B, N] of the point of b [B, M, 3] nearest to each point of a [B, N, 3]."""
    try:
        from scipy.spatial import cKDTree  # here, as its import takes longer than that of nmr
    except ImportError:
        cKDTree = None

    def search_tree(x: Tensor, y: Tensor) -> Tensor:
        _, number = cKDTree(y.numpy()).query(x.numpy(), workers=torch.get_num_threads())
        return torch.from_numpy(number)

    in_host_memory = a.device.type == "cpu" and not torch._C._are_functorch_transforms_active()
    search = search_tree if cKDTree is not None and in_host_memory else _search_all
    return torch.stack([search(x, y) for x, y in zip(a, b, strict=True)])


def _search_all(a: Tensor, b: Tensor) -> Tensor:
    # Not the fast formula |x|^2 - 2 x.y + |y|^2: it is too inexact to separate near points.
    exact = "donot_use_mm_for_euclid_dist"
    chunks = a.split(max(1, _CHUNK // len(b)))
    return torch.cat([torch.cdist(chunk, b, compute_mode=exact).argmin(1) for chunk in chunks])
