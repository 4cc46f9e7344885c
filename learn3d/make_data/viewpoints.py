"""Random numbers of cameras, rounded to 4 decimals, so that text files hold exactly what was drawn."""

from __future__ import annotations

import numpy as np

ROOM = (1.02, 1.25)  # distance, over the least one from which the whole bounding sphere is seen


def uniform(rng: np.random.Generator, limits: tuple[float, float], count: int) -> np.ndarray:
    """float32 [count] in [low, high); what rounding brings up to `high` becomes `low`, the same angle."""
    low, high = limits
    values = np.round(rng.uniform(low, high, count), 4)
    return np.where(values >= high, low, values).astype(np.float32)


def distances(rng: np.random.Generator, vertices: np.ndarray, half_fov_deg: np.ndarray) -> np.ndarray:
    """float32 [count]: from there a sphere around the origin that holds the vertices [V, 3] fits into the image."""
    radius = float(np.linalg.norm(vertices, axis=1).max())
    least = radius / np.sin(np.deg2rad(half_fov_deg.astype(np.float64)))
    return np.round(least * rng.uniform(*ROOM, len(least)), 4).astype(np.float32)
