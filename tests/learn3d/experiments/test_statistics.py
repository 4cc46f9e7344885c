"""Intervals over seeds and over objects."""

from __future__ import annotations

import math

import numpy as np
import pytest

from learn3d.experiments.statistics import percentile_interval, resampled_means, t_interval


def test_t_interval_by_hand() -> None:
    low, high = t_interval([0.50, 0.52, 0.57])
    half = 4.302653 * math.sqrt((0.03**2 + 0.01**2 + 0.04**2) / 2 / 3)  # t of two degrees of freedom
    assert (low, high) == pytest.approx((0.53 - half, 0.53 + half))
    assert t_interval([0.5]) is None


def test_bootstrap_is_over_objects_not_images() -> None:
    """Ten objects that differ, each with 24 images all alike: the interval is that of ten values, not of 240."""
    means = np.linspace(0.1, 1.0, 10)
    low, high = percentile_interval(resampled_means([24 * means], [np.full(10, 24.0)]))
    error = means.std() / math.sqrt(10)
    assert (0.55 - low, high - 0.55) == pytest.approx((1.96 * error, 1.96 * error), rel=0.12)


def test_bootstrap_interval_covers_the_true_mean() -> None:
    rng, covered = np.random.default_rng(1), 0
    for trial in range(60):
        low, high = percentile_interval(resampled_means([rng.normal(0.5, 0.1, 40)], [np.ones(40)], seed=trial))
        covered += low <= 0.5 <= high
    assert covered >= 51, "about 57 of 60 are expected"


def test_bootstrap_weighs_images_and_categories() -> None:
    one = resampled_means([np.array([3.0, 1.0])], [np.array([3.0, 2.0])])
    assert set(np.round(one, 6)) <= {1.0, 0.5, 0.8}, "mean over images: 3/3, 1/2 or 4/5"
    both = resampled_means([np.array([1.0]), np.array([0.0, 0.0])], [np.array([1.0]), np.array([1.0, 1.0])])
    assert np.all(both == 0.5), "then over categories, however many objects they have"


def test_paired_difference_has_the_smaller_interval() -> None:
    rng = np.random.default_rng(0)
    objects = rng.uniform(0.2, 0.8, 30)
    a, b = (resampled_means([objects + shift], [np.ones(30)]) for shift in (0.05, 0.0))
    assert percentile_interval(a - b) == pytest.approx((0.05, 0.05))
    assert np.ptp(percentile_interval(a)) > 0.1
