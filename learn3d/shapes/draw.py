"""Random numbers and choices for the recipes of shapes."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

T = TypeVar("T")


class Draw:
    """Random numbers and choices from a generator: `width = draw(0.4, 0.5)`, `if draw.maybe(0.3)`."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __call__(self, least: float, greatest: float) -> float:
        """A random number in [least, greatest)."""
        return self._rng.uniform(least, greatest)

    def measures(self, **ranges: tuple[float, float]) -> dict[str, float]:
        """A random number for each named range (least, greatest)."""
        return {name: self(*limits) for name, limits in ranges.items()}

    def count(self, least: int, greatest: int) -> int:
        """A random whole number from `least` to `greatest`, both included."""
        return int(self._rng.integers(least, greatest + 1))

    def maybe(self, probability: float) -> bool:
        """True with the given probability."""
        return bool(self._rng.random() < probability)

    def pick(self, options: dict[T, float] | tuple[T, ...]) -> T:
        """One of the options, with equal probability or, for a dict, in proportion to its values."""
        keys = tuple(options)
        weights = np.cumsum(list(options.values()) if isinstance(options, dict) else np.ones(len(keys)))
        return keys[min(int(np.searchsorted(weights, self._rng.random() * weights[-1], side="right")), len(keys) - 1)]
