"""Words for random decisions, so that the recipes of the shapes read as sentences."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

T = TypeVar("T")


def pick(rng: np.random.Generator, options: dict[T, float] | tuple[T, ...]) -> T:
    """One of the options: with equal chances, or with the weights that a dict gives them."""
    keys = tuple(options)
    weights = np.cumsum(list(options.values()) if isinstance(options, dict) else np.ones(len(keys)))
    return keys[min(int(np.searchsorted(weights, rng.random() * weights[-1], side="right")), len(keys) - 1)]


def maybe(rng: np.random.Generator, probability: float) -> bool:
    """True with the given probability."""
    return bool(rng.random() < probability)


def drawn(rng: np.random.Generator, **measures: float | tuple[float, float]) -> dict[str, float]:
    """The measures, each pair (least, largest) replaced by a random number between the two."""
    return {name: rng.uniform(*value) if isinstance(value, tuple) else value for name, value in measures.items()}
