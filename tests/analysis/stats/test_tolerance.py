from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from analysis.cli import main
from analysis.stats.intervals import Statistic
from analysis.stats.tolerance import CONTENT, FEWEST, BandKind, tolerance_band, tolerance_places


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
