"""Cleaning of found meshes (weld, drop, centre) and the comparison that finds near-duplicates."""

from __future__ import annotations

import numpy as np
import trimesh

from learn3d.files import limits
from learn3d.make_data.meshes import RawMesh, checked, fit_to_box

_SAMPLES = 2_000_000  # points of surfaces in memory at a time


def clean_mesh(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    """The welded mesh with its box centred at the origin and its longest side 1.

    Vertices closer than about 1e-5 of the longest side become one; faces without area, repeated faces (in whatever
    winding) and unused vertices go. Raises ValueError if nothing solid is left or a coordinate is not finite.
    """
    raw = checked(RawMesh(vertices, faces), limits.MESH_FACES)
    mesh = trimesh.Trimesh(fit_to_box(raw.vertices), raw.faces, process=False)
    mesh.merge_vertices(digits_vertex=5)
    mesh.update_faces((mesh.area_faces > 1e-12) & mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) == 0:
        raise ValueError("no face has an area")
    if mesh.extents.min() < 1e-3 * mesh.extents.max():
        raise ValueError("it is flat")
    mesh.vertices = fit_to_box(mesh.vertices)
    return mesh


def surface_grid(vertices: np.ndarray, faces: np.ndarray, size: int, per_axis: bool = False) -> np.ndarray:
    """Cells bool [size, size, size] that the surface passes through, by samples at most a third of a cell apart.

    The box is centred in the grid and its longest side fills it; with `per_axis` each side fills it.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extents = high - low
    scale = np.where(extents > 0, extents, 1.0) if per_axis else extents.max()
    corners = (((vertices - (low + high) / 2) / scale + 0.5) * size)[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(3 * edges).astype(np.int64), 1)
    grid = np.zeros((size, size, size), dtype=bool)
    for count in np.unique(steps):
        i, j = np.divmod(np.arange((count + 1) ** 2), count + 1)
        i, j = i[i + j <= count], j[i + j <= count]
        weights = np.stack([i, j, count - i - j], axis=1) / count
        chosen = corners[steps == count]
        for part in np.array_split(chosen, 1 + len(chosen) * len(weights) // _SAMPLES):
            cells = np.clip(np.floor((weights @ part).reshape(-1, 3)).astype(np.int64), 0, size - 1)
            grid[tuple(cells.T)] = True
    return grid


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two bool grids that are not both empty."""
    return float(np.count_nonzero(a & b) / np.count_nonzero(a | b))
