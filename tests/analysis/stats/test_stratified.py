from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from analysis.stats.stratified import RESAMPLES, stratified_mean

SIZES = (12, 20, 35)


def runs(seed: int, sizes: tuple[int, ...] = SIZES) -> list[npt.NDArray[np.float64]]:
    """Return runs of systems of different level and spread, two values each."""
    rng = np.random.default_rng(seed)
    return [rng.normal(place, place + 1.0, (n, 2)) for place, n in enumerate(sizes)]


def test_every_system_counts_alike() -> None:
    strata = [np.array([[0.0]] * 9 + [[1.0]]), np.array([[1.0], [3.0]])]
    assert stratified_mean(strata).centre == pytest.approx([(0.1 + 2.0) / 2])


def test_the_interval_is_that_of_scipy() -> None:
    strata = runs(0)
    found = stratified_mean(strata)
    one = [values[:, 0] for values in strata]
    scipy = stats.bootstrap(
        one,
        lambda *parts, axis: np.mean([np.mean(part, axis=axis) for part in parts], axis=0),
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(1),
    )
    error = 5 * scipy.standard_error / np.sqrt(RESAMPLES * 0.025)  # of a 2.5 % quantile, at least
    assert found.low[0] == pytest.approx(scipy.confidence_interval.low, abs=error)
    assert found.high[0] == pytest.approx(scipy.confidence_interval.high, abs=error)


def test_the_share_of_one_system_has_binomial_quantiles() -> None:
    n, hits = 40, 14
    values = np.repeat([1.0, 0.0], [hits, n - hits])[:, None]
    found = stratified_mean([values])
    quantiles = stats.binom.ppf([0.025, 0.975], n, hits / n) / n
    assert found.low[0] == pytest.approx(quantiles[0], abs=1.01 / n)
    assert found.high[0] == pytest.approx(quantiles[1], abs=1.01 / n)


def test_it_covers_about_as_often_as_it_says() -> None:
    repeats, truth = 400, np.mean(np.arange(4.0))
    bands = [stratified_mean(runs(seed, (20, 20, 20, 20))) for seed in range(repeats)]
    covered = np.mean([(one.low[0] <= truth) & (one.high[0] >= truth) for one in bands])
    assert 0.90 < covered < 0.98


def test_the_same_runs_give_the_same_interval_and_one_run_gives_none() -> None:
    np.testing.assert_array_equal(stratified_mean(runs(3)).low, stratified_mean(runs(3)).low)
    alone = stratified_mean([np.ones((5, 1)), np.array([[2.0]])])
    assert alone.centre == pytest.approx([1.5])
    assert np.isnan([alone.low, alone.high]).all()
