"""Confidence intervals over test objects, by the bootstrap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

RESAMPLES = 2000


def resampled_means(sums: Sequence[np.ndarray], counts: Sequence[np.ndarray], *, seed: int = 0) -> np.ndarray:
    """Means of 2,000 resampled test sets, float64 [2000].

    sums[c], counts[c] float [N_c]: sum of a measure over the images of each object of category c, and their number. The
    images of an object are not independent of each other, so objects are drawn, with replacement, within each category;
    the mean over the images of each category is taken, then that over categories. The draws depend on the seed and the
    numbers of objects alone: two results of the same objects have the same ones and can be subtracted, which makes the
    bootstrap of their difference a paired one. (scipy.stats.bootstrap knows neither strata nor weights.)
    """
    rng = np.random.default_rng(seed)
    total = np.zeros(RESAMPLES)
    for part, number in zip(sums, counts, strict=True):
        for start in range(0, RESAMPLES, 250):
            drawn = rng.integers(len(part), size=(250, len(part)))
            with np.errstate(invalid="ignore", divide="ignore"):
                total[start : start + 250] += part[drawn].sum(1) / number[drawn].sum(1)
    return total / len(sums)


def percentile_interval(resampled: np.ndarray) -> tuple[float, float] | None:
    """The middle 95 % of resampled values; None if none is defined."""
    known = resampled[np.isfinite(resampled)]
    return tuple(np.quantile(known, [0.025, 0.975]).tolist()) if len(known) else None
