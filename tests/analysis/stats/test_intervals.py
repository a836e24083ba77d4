from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from analysis.stats.intervals import BAND_RESAMPLES, Statistic, centre, mean, standard_error
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
