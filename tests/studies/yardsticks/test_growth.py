"""Exponents of growth: known laws, intervals, trials that are censored."""

from __future__ import annotations

import numpy as np
import pytest

from studies.yardsticks.common import exponent, median, slopes

SIZES = (2, 5, 10, 20, 50)


def scattered(power: float, seed: int, n: int = 100) -> dict[int, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {size: 3.0 * size**power * np.exp(0.3 * rng.normal(size=n)) for size in SIZES}


def test_the_exponent_of_a_power_law_is_its_power() -> None:
    exact = {size: np.full(4, 3.0 * size**1.25) for size in SIZES}
    found = exponent(exact, np.random.default_rng(0))
    assert found == pytest.approx((1.25, 1.25, 1.25), rel=1e-12)
    assert slopes(SIZES, np.array([[size**0.5 for size in SIZES]])) == pytest.approx([0.5])


def test_intervals_cover_the_power_and_are_as_wide_as_its_estimates_scatter() -> None:
    found = np.array(
        [exponent(scattered(1.2, seed, n=40), np.random.default_rng(seed)) for seed in range(30)]
    )
    centres, low, high = found.T
    assert np.sum((low <= 1.2) & (high >= 1.2)) >= 24  # of 30; fewer come once in 1,700 times
    assert np.mean(high - low) == pytest.approx(2 * 1.96 * np.std(centres), rel=0.4)


def test_sizes_whose_median_is_not_reached_are_left_out() -> None:
    samples = scattered(1.0, 1)
    whole = exponent({s: v for s, v in samples.items() if s < 50}, np.random.default_rng(3))
    samples[50][:60] = np.inf
    assert exponent(samples, np.random.default_rng(3)) == whole
    few = {size: samples[size] for size in (2, 5, 50)}
    assert np.isnan(exponent(few, np.random.default_rng(3))).all()


def test_a_median_may_be_censored_in_part() -> None:
    values = np.concatenate([np.arange(1.0, 56.0), np.full(45, np.inf)])
    centre, low, high = median(values, np.random.default_rng(0))
    assert centre == 50.5
    assert 35 < low < centre < high
    assert median(np.full(9, np.inf), np.random.default_rng(0)) == (np.inf, np.inf, np.inf)
