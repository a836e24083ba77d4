"""Centres, their intervals, tolerance intervals, and means over several systems."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from analysis.cli import main
from analysis.stats.intervals import (
    BAND_RESAMPLES,
    CONTENT,
    FEWEST,
    RESAMPLES,
    BandKind,
    Statistic,
    centre,
    mean,
    standard_error,
    stratified_mean,
    tolerance_band,
    tolerance_places,
)
from analysis.stats.intervals import band as band_of


def test_band_of_three_numbers_by_hand() -> None:
    band = band_of(np.array([[1.0], [2.0], [3.0]]))
    half = 4.302652729911275 / np.sqrt(3)  # t quantile of 2 degrees of freedom
    assert band.centre[0] == 2.0
    assert band.low[0] == pytest.approx(2 - half)
    assert band.high[0] == pytest.approx(2 + half)
    assert band.n == 3


def test_each_step_has_its_own_band() -> None:
    values = np.array([[1.0, 5.0], [3.0, 5.0]])
    band = band_of(values)
    assert band.centre.tolist() == [2.0, 5.0]
    assert (band.high - band.low)[1] == 0.0
    assert (band.high - band.low)[0] > 0


def test_one_trial_has_a_mean_and_no_interval() -> None:
    band = band_of(np.array([[4.0, 2.0]]))
    assert band.centre.tolist() == [4.0, 2.0]
    assert np.isnan(band.low).all()
    assert np.isnan(band.high).all()


def test_no_trial_gives_nan_without_a_warning() -> None:
    assert np.isnan(band_of(np.empty((0, 3))).centre).all()
    assert np.isnan(mean(np.empty(0)))
    assert np.isnan(standard_error(np.array([1.0])))


@pytest.mark.parametrize("n", [4, 20])
def test_the_interval_covers_the_mean_of_normal_trials_as_often_as_it_says(n: int) -> None:
    repeats = 20_000  # every column is an experiment of its own
    values = np.random.default_rng(n).normal(loc=3.0, scale=2.0, size=(n, repeats))
    band = band_of(values)
    covered = np.mean((band.low <= 3.0) & (band.high >= 3.0))
    assert covered == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / repeats))


def test_centres_by_hand() -> None:
    values = np.array([[0.0], [1.0], [2.0], [3.0], [4.0], [5.0], [6.0], [700.0]])
    assert centre(values, Statistic.MEDIAN)[0] == 3.5
    assert centre(values, Statistic.IQM)[0] == (2 + 3 + 4 + 5) / 4  # two of eight off each end
    assert centre(values, Statistic.MEAN)[0] == pytest.approx(721 / 8)


@pytest.mark.parametrize("statistic", [Statistic.MEDIAN, Statistic.IQM])
def test_an_outlier_moves_the_robust_centres_little(statistic: Statistic) -> None:
    values = np.random.default_rng(0).normal(size=(41, 1))
    moved = np.where(values == values.max(), 1e6, values)
    assert centre(moved, statistic)[0] == pytest.approx(centre(values, statistic)[0], abs=1e-9)
    assert centre(moved, Statistic.MEAN)[0] > 1e4


@pytest.mark.parametrize("statistic", [Statistic.MEDIAN, Statistic.IQM])
def test_the_bootstrap_draws_whole_trials_and_the_same_ones_each_time(
    statistic: Statistic,
) -> None:
    trials = np.random.default_rng(1).normal(size=(15, 1))
    curves = np.hstack([trials, trials, 2 * trials])  # a step repeated, and one scaled
    first, again = band_of(curves, statistic), band_of(curves, statistic)
    np.testing.assert_array_equal(first.low, again.low)
    assert first.low[0] == first.low[1]
    assert first.low[2] == pytest.approx(2 * first.low[0])
    assert (first.low <= first.centre).all()
    assert (first.centre <= first.high).all()


def test_the_bootstrap_of_a_curve_longer_than_a_batch_is_that_of_its_parts() -> None:
    curves = np.random.default_rng(2).lognormal(size=(9, 7))
    whole, part = band_of(curves, Statistic.IQM), band_of(curves[:, 3:5], Statistic.IQM)
    np.testing.assert_allclose(whole.low[3:5], part.low)


@pytest.mark.parametrize("statistic", [Statistic.MEDIAN, Statistic.IQM])
def test_the_bootstrap_interval_covers_about_as_often_as_it_says(statistic: Statistic) -> None:
    # Of a symmetric distribution, whose median and interquartile mean are both its centre.
    repeats, n = 300, 40
    experiments = np.random.default_rng(3).laplace(loc=1.0, size=(repeats, n))
    bands = [band_of(one[:, None], statistic) for one in experiments]
    covered = np.mean([found.low[0] <= 1.0 <= found.high[0] for found in bands])
    assert 0.90 < covered < 0.99


def test_names_are_those_of_the_captions() -> None:
    assert Statistic.MEAN.band == "95 % t-interval of the mean"
    assert Statistic.IQM.band == "95 % bootstrap interval of the interquartile mean"


@pytest.mark.parametrize("statistic", [Statistic.MEDIAN, Statistic.IQM])
@pytest.mark.parametrize("n", [2, 3, 5, 20, 31])
def test_the_bootstrap_is_that_of_scipy(statistic: Statistic, n: int) -> None:
    values = np.exp(np.random.default_rng(n).normal(size=(n, 6)))
    values[:, 3] = 1.0
    values[: n // 2, 4] = 2.0  # ties
    values[0, 5] = 1e12
    centres = {Statistic.MEDIAN: np.median, Statistic.IQM: iqm}
    found = stats.bootstrap(
        (values,),
        centres[statistic],
        n_resamples=BAND_RESAMPLES,
        batch=100,
        confidence_level=0.95,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    shown = band_of(values, statistic)
    assert shown.low == pytest.approx(found.low, rel=1e-12)
    assert shown.high == pytest.approx(found.high, rel=1e-12)


def iqm(values: npt.NDArray[np.float64], axis: int) -> npt.NDArray[np.float64]:
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


def confidence(n: int, inside: int) -> float:
    """Return how sure it is that ``inside`` of the n + 1 gaps between runs hold 90 % of them."""
    return float(stats.binom.cdf(inside - 1, n, CONTENT))


@pytest.mark.parametrize("n", [FEWEST, 76, 77, 100, 1000])
def test_as_many_runs_are_left_out_as_the_binomial_distribution_allows(n: int) -> None:
    places = tolerance_places(n)
    assert places is not None
    low, high = places
    assert low == n - 1 - high
    assert confidence(n, high - low) >= 0.95
    assert confidence(n, high - low - 2) < 0.95


@pytest.mark.parametrize("n", [0, 1, 2, 20, FEWEST - 1])
def test_few_runs_have_no_limits(n: int) -> None:
    assert tolerance_places(n) is None
    assert confidence(n, max(n - 1, 0)) < 0.95  # even with the smallest and the largest of them
    band = tolerance_band(np.ones((n, 2)))
    assert np.isnan(band.low).all()
    assert np.isnan(band.high).all()


@pytest.mark.parametrize("n", [FEWEST, 100])
def test_limits_hold_the_share_as_often_as_they_say(n: int) -> None:
    repeats = 20_000  # every column is an experiment of its own
    runs = np.random.default_rng(n).lognormal(size=(n, repeats))
    band = tolerance_band(runs, Statistic.MEDIAN)
    share = stats.lognorm.cdf(band.high, 1.0) - stats.lognorm.cdf(band.low, 1.0)
    places = tolerance_places(n)
    assert places is not None
    exact = confidence(n, places[1] - places[0])
    held = float(np.mean(share >= CONTENT))
    assert held == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / repeats))
    assert held >= 0.95
    assert band.centre == pytest.approx(np.median(runs, axis=0))


def test_figure_1_names_the_band_and_the_lines_without_one(url: str, tmp_path: Path) -> None:
    given = ["figures", "--db", url, "--env", "cartpole", "--out", str(tmp_path)]
    assert main([*given, "--only", "figure1", "--band", "tolerance"]) == 0
    words = (tmp_path / "figure1.txt").read_text()
    assert "tolerance interval, 90 % of runs with 95 % confidence" in words
    assert "fewer than 46 trials have none: cartpole D-optimal (n = 5)" in words
    assert BandKind.CONFIDENCE.label(Statistic.IQM) == Statistic.IQM.band


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
