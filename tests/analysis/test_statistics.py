from __future__ import annotations

import numpy as np
import pytest

from analysis.statistics import mean, mean_band, standard_error


def test_band_of_three_numbers_by_hand() -> None:
    band = mean_band(np.array([[1.0], [2.0], [3.0]]))
    half = 4.302652729911275 / np.sqrt(3)  # t quantile of 2 degrees of freedom
    assert band.mean[0] == 2.0
    assert band.low[0] == pytest.approx(2 - half)
    assert band.high[0] == pytest.approx(2 + half)
    assert band.n == 3


def test_each_step_has_its_own_band() -> None:
    values = np.array([[1.0, 5.0], [3.0, 5.0]])
    band = mean_band(values)
    assert band.mean.tolist() == [2.0, 5.0]
    assert (band.high - band.low)[1] == 0.0
    assert (band.high - band.low)[0] > 0


def test_one_trial_has_a_mean_and_no_interval() -> None:
    band = mean_band(np.array([[4.0, 2.0]]))
    assert band.mean.tolist() == [4.0, 2.0]
    assert np.isnan(band.low).all()
    assert np.isnan(band.high).all()


def test_no_trial_gives_nan_without_a_warning() -> None:
    assert np.isnan(mean_band(np.empty((0, 3))).mean).all()
    assert np.isnan(mean(np.empty(0)))
    assert np.isnan(standard_error(np.array([1.0])))


@pytest.mark.parametrize("n", [4, 20])
def test_the_interval_covers_the_mean_of_normal_trials_as_often_as_it_says(n: int) -> None:
    repeats = 20_000  # every column is an experiment of its own
    values = np.random.default_rng(n).normal(loc=3.0, scale=2.0, size=(n, repeats))
    band = mean_band(values)
    covered = np.mean((band.low <= 3.0) & (band.high >= 3.0))
    assert covered == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / repeats))
