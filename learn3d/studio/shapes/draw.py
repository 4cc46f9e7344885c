"""Recipes of shapes start here: random numbers and choices, outlines, points and paths.

Outlines are closed curves [N, 2], counter-clockwise, star-shaped about their mean.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

Point = Sequence[float] | np.ndarray  # (x, y, z); in a profile (radius, y)


class Draw(np.random.Generator):
    """Random numbers and choices: `width = draw(0.4, 0.5)`, `if draw.maybe(0.3)`.

    A *space* says what can be drawn: a pair (least, greatest) a number between them; a range a
    whole number of it; a list one of its items; a dict one of its keys, in proportion to the
    values; a probability True or False.
    """

    loads = True  # whether cars may have boxes on their roofs

    def __call__(self, least: float, greatest: float) -> float:
        """A random number in [least, greatest)."""
        return self.uniform(least, greatest)

    def of(self, space: Any) -> Any:
        """A random value of a space."""
        if isinstance(space, Perhaps):
            return self.of(space.space) if self.maybe(space.probability) else space.otherwise
        if isinstance(space, tuple):
            return self(*space)
        if isinstance(space, range):
            return self.count(space[0], space[-1])
        if isinstance(space, float):
            return self.maybe(space)
        return self.pick(space)

    def measures(self, **spaces: Any) -> dict[str, Any]:
        """A random value of each named space, in this order."""
        return {name: self.of(space) for name, space in spaces.items()}

    def count(self, least: int, greatest: int) -> int:
        """A random whole number from `least` to `greatest`, both included."""
        return int(self.integers(least, greatest + 1))

    def maybe(self, probability: float) -> bool:
        """True with the given probability."""
        return self.random() < probability

    def pick(self, options: dict[Any, float] | list) -> Any:
        """One of a list with equal probability, or of a dict's keys in proportion to the values."""
        weights = list(options.values()) if isinstance(options, dict) else np.ones(len(options))
        ends = np.cumsum(weights)
        return list(options)[np.searchsorted(ends, self.random() * ends[-1], side="right")]


class Perhaps(NamedTuple):
    """The space of a measure: drawn from `space` with a probability, else `otherwise`."""

    probability: float
    space: Any
    otherwise: float | None = 0.0


def recipe(**spaces: Any) -> Callable[[Callable], Callable]:
    """A decorator of `make(draw, ..., *, <names>)`: its keyword arguments are random measures.

    They are drawn in this order, before the body draws others. A measure that the caller gives is
    not drawn.

    >>> @recipe(width=(0.3, 0.45), arms=0.5)
    ... def seat(draw: Draw, *, width: float, arms: bool): ...
    """

    def decorate(make: Callable) -> Callable:
        @functools.wraps(make)
        def with_measures(draw: Draw, *args: Any, **given: Any) -> Any:
            missing = {name: space for name, space in spaces.items() if name not in given}
            return make(draw, *args, **given, **draw.measures(**missing))

        return with_measures

    return decorate


def shares(count: int) -> np.ndarray:
    """`count` numbers from 0 to 1, equally spaced."""
    return np.linspace(0, 1, count)


def spread(half: float, count: int) -> np.ndarray:
    """`count` places that divide the distance from -half to half into equal parts."""
    return np.linspace(-half, half, count + 2)[1:-1]


def points(x: float | np.ndarray, y: float | np.ndarray, z: float | np.ndarray) -> np.ndarray:
    """The points [..., 3] with these coordinates, which broadcast against each other."""
    return np.stack(np.broadcast_arrays(x, y, z), -1)


def ellipse(width: float, depth: float, count: int = 20, exponent: float = 2.0) -> np.ndarray:
    """A (super)ellipse [count, 2]: exponent 2 is an ellipse, larger ones approach a rectangle."""
    angle = np.arange(count) * (2.0 * np.pi / count)
    cosine, sine = np.cos(angle), np.sin(angle)
    power = 2.0 / exponent
    x, y = np.sign(cosine) * np.abs(cosine) ** power, np.sign(sine) * np.abs(sine) ** power
    return np.c_[0.5 * width * x, 0.5 * depth * y]


def rectangle(
    width: float, depth: float, radius: float | None = None, segments: int = 2
) -> np.ndarray:
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
    return (
        corner * (np.array([width, depth]) / 2 - radius)
        + radius * np.c_[np.cos(angle), np.sin(angle)]
    )


def inset(outline: np.ndarray, distance: float) -> np.ndarray:
    """The outline moved inwards by `distance` along its mitred vertex normals."""
    edge = np.roll(outline, -1, 0) - outline
    normal = np.c_[edge[:, 1], -edge[:, 0]] / np.maximum(
        np.linalg.norm(edge, axis=1, keepdims=True), 1e-12
    )
    mitre = normal + np.roll(normal, 1, 0)
    return outline - mitre * (2.0 * distance / np.maximum((mitre**2).sum(1, keepdims=True), 0.5))


def rounded_path(
    points: Sequence[Point], radius: float, segments: int = 4, closed: bool = False
) -> np.ndarray:
    """The polyline [P, 3] with rounded corners; the curves start `radius` before them."""
    points = np.asarray(points, dtype=float)
    t = np.linspace(0.0, 1.0, segments + 1)[:, None]
    sides = np.stack([np.roll(points, 1, 0), np.roll(points, -1, 0)]) - points
    length = np.apply_along_axis(np.linalg.norm, 2, sides)[..., None]
    start, end = (points + sides * (np.minimum(radius, 0.45 * length) / length))[:, :, None]
    arcs = (1 - t) ** 2 * start + 2 * t * (1 - t) * points[:, None] + t**2 * end
    return np.concatenate(arcs if closed else [points[:1], *arcs[1:-1], points[-1:]])
