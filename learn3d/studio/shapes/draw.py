"""Recipes of shapes start here: random numbers and choices, outlines, points and paths.

Outlines are closed curves [N, 2], counter-clockwise, star-shaped about their mean.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

Point = Sequence[float] | np.ndarray  # (x, y, z); in a profile (radius, y)


class Draw(np.random.Generator):
    """Random numbers and choices: `width = draw(0.4, 0.5)`, `if draw.maybe(0.3)`."""

    def __call__(self, least: float, greatest: float) -> float:
        """A random number in [least, greatest)."""
        return self.uniform(least, greatest)

    def measures(self, **ranges: tuple[float, float]) -> dict[str, float]:
        """A random number for each named range (least, greatest)."""
        return {name: self(*limits) for name, limits in ranges.items()}

    def count(self, least: int, greatest: int) -> int:
        """A random whole number from `least` to `greatest`, both included."""
        return int(self.integers(least, greatest + 1))

    def maybe(self, probability: float) -> bool:
        """True with the given probability."""
        return self.random() < probability

    def pick(self, options: dict[Any, float] | Sequence, weights: Sequence[float] = ()) -> Any:
        """One of the options, in proportion to the weights or to a dict's values, else with equal probability."""
        weights = weights or (list(options.values()) if isinstance(options, dict) else np.ones(len(options)))
        ends = np.cumsum(weights)
        return tuple(options)[np.searchsorted(ends, self.random() * ends[-1], side="right")]


def points(x: float | np.ndarray, y: float | np.ndarray, z: float | np.ndarray) -> np.ndarray:
    """The points [..., 3] with these coordinates, which broadcast against each other."""
    return np.stack(np.broadcast_arrays(x, y, z), -1)


def ellipse(width: float, depth: float, count: int = 20, exponent: float = 2.0) -> np.ndarray:
    """A (super)ellipse outline [count, 2]; exponent 2 is an ellipse, larger ones approach a rectangle."""
    angle = np.arange(count) * (2.0 * np.pi / count)
    cosine, sine = np.cos(angle), np.sin(angle)
    power = 2.0 / exponent
    x, y = np.sign(cosine) * np.abs(cosine) ** power, np.sign(sine) * np.abs(sine) ** power
    return np.c_[0.5 * width * x, 0.5 * depth * y]


def rectangle(width: float, depth: float, radius: float | None = None, segments: int = 2) -> np.ndarray:
    """The outline [4 (segments + 1), 2] of a rectangle with rounded corners.

    The default radius is 12 % of the short side. With 0 segments the corners are sharp.
    """
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    if segments == 0:
        return corner * np.array([width, depth]) / 2
    short = min(width, depth)
    radius = 0.12 * short if radius is None else min(max(radius, 0.01 * short), 0.49 * short)
    angle = np.concatenate([np.linspace(k, k + 1, segments + 1) for k in range(4)]) * (np.pi / 2)
    corner = np.repeat(corner, segments + 1, 0)
    return corner * (np.array([width, depth]) / 2 - radius) + radius * np.c_[np.cos(angle), np.sin(angle)]


def inset(outline: np.ndarray, distance: float) -> np.ndarray:
    """The outline moved inwards by `distance` along its mitred vertex normals."""
    edge = np.roll(outline, -1, 0) - outline
    normal = np.c_[edge[:, 1], -edge[:, 0]] / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    mitre = normal + np.roll(normal, 1, 0)
    return outline - mitre * (2.0 * distance / np.maximum((mitre**2).sum(1, keepdims=True), 0.5))


def rounded_path(points: Sequence[Point], radius: float, segments: int = 4, closed: bool = False) -> np.ndarray:
    """The polyline [P, 3] with each corner replaced by an arc-like curve that starts `radius` before the corner."""
    points = np.asarray(points, dtype=float)
    t = np.linspace(0.0, 1.0, segments + 1)[:, None]
    sides = np.stack([np.roll(points, 1, 0), np.roll(points, -1, 0)]) - points
    length = np.apply_along_axis(np.linalg.norm, 2, sides)[..., None]
    start, end = (points + sides * (np.minimum(radius, 0.45 * length) / length))[:, :, None]
    arcs = (1 - t) ** 2 * start + 2 * t * (1 - t) * points[:, None] + t**2 * end
    return np.concatenate(arcs if closed else [points[:1], *arcs[1:-1], points[-1:]])
