"""Cleaning of found meshes (weld, drop, centre) and the comparison that finds near-duplicates."""

from __future__ import annotations

import numpy as np

_SAMPLES = 2_000_000  # points of surfaces in memory at a time


def clean_mesh(vertices: np.ndarray, faces: np.ndarray, tolerance: float = 1e-5) -> tuple[np.ndarray, np.ndarray]:
    """The welded mesh with its box centred at the origin and its longest side 1: float64 [V, 3], int64 [F, 3].

    Vertices closer than about `tolerance` of the longest side become one; faces without area, repeated faces (in
    whatever winding) and unused vertices go.
    Raises ValueError when nothing solid is left or a coordinate is not finite.
    """
    if len(faces) == 0:
        raise ValueError("it has no faces")
    vertices = vertices[: faces.max() + 1]
    if not np.isfinite(vertices[faces]).all():
        raise ValueError("a coordinate is not finite")
    used = vertices[np.unique(faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    side = (high - low).max()
    if side == 0:
        raise ValueError("it is a single point")
    points = (vertices - (low + high) / 2) / side

    cells = np.round(points / tolerance)
    cells[~np.isfinite(cells)] = 0  # of vertices that no face uses
    _, first, label = np.unique(cells.astype(np.int64), axis=0, return_index=True, return_inverse=True)
    points, faces = points[first], label.reshape(-1)[faces]

    a, b, c = (points[faces[:, i]] for i in range(3))
    solid = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12
    solid &= (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[solid]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    if len(faces) == 0:
        raise ValueError("no face has an area")
    kept, faces = np.unique(faces, return_inverse=True)
    points = points[kept]
    extents = np.ptp(points, axis=0)
    if extents.min() < 1e-3 * extents.max():
        raise ValueError("it is flat")
    points = (points - (points.min(axis=0) + points.max(axis=0)) / 2) / extents.max()
    return points, faces.reshape(-1, 3).astype(np.int64)


def surface_grid(vertices: np.ndarray, faces: np.ndarray, size: int, per_axis: bool = False) -> np.ndarray:
    """Cells bool [size, size, size] that the surface passes through, by samples at most a third of a cell apart.

    The box is centred in the grid and its longest side fills it; with `per_axis` each side fills it.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extents = high - low
    scale = np.where(extents > 0, extents, 1.0) if per_axis else extents.max()
    points = ((vertices - (low + high) / 2) / scale + 0.5) * size
    corners = points[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(3 * edges).astype(np.int64), 1)
    grid = np.zeros((size, size, size), dtype=bool)
    for count in np.unique(steps):
        i, j = np.divmod(np.arange((count + 1) ** 2), count + 1)
        i, j = i[i + j <= count], j[i + j <= count]
        weights = np.stack([i, j, count - i - j], axis=1) / count
        chosen = corners[steps == count]
        for part in np.array_split(chosen, 1 + len(chosen) * len(weights) // _SAMPLES):
            cells = (weights @ part).reshape(-1, 3)
            cells = np.clip(np.floor(cells).astype(np.int64), 0, size - 1)
            grid[cells[:, 0], cells[:, 1], cells[:, 2]] = True
    return grid


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two bool grids that are not both empty."""
    return float(np.count_nonzero(a & b) / np.count_nonzero(a | b))
