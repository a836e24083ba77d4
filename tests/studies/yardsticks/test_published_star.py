"""Rows about the moving star follow from their trials, and the claims from the rows."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from studies.yardsticks.star import tabulate
from tests.pages import DOCS

TABLE = pd.read_csv(DOCS / "yardsticks/flex_star.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/flex_star_trials.csv")
ROWS = TABLE.set_index(["learner", "policy"]).sort_index()
SLOW, FAST, FIT = "adam, rate 0.01", "adam, rate 0.02", "gauss_newton"


def test_the_rows_follow_from_the_trials() -> None:
    found = tabulate(TRIALS).set_index(["learner", "policy"]).sort_index()
    assert found.to_numpy(float) == pytest.approx(ROWS.to_numpy(float), rel=1e-9, nan_ok=True)
    assert (ROWS.n == 100).all()
    for _, part in TRIALS.groupby(["learner", "policy"]):
        assert sorted(part.seed) == list(range(100, 200))


def test_the_claims_are_decided_by_the_intervals() -> None:
    assert ROWS.median_low[SLOW, "random"] <= 3.0 <= ROWS.median_high[SLOW, "random"]
    for learner in (SLOW, FAST):
        assert ROWS.ratio_high[learner, "d_optimal"] < 0.2
    assert ROWS.ratio_low[FIT, "d_optimal"] < 1.0 < ROWS.ratio_high[FIT, "d_optimal"]
    assert ROWS.median_high[FAST, "d_optimal"] < 1e-3 < ROWS.median_low[SLOW, "d_optimal"] / 10
    assert ROWS.ratio_high[SLOW, "episodic"] < ROWS.ratio_low[SLOW, "d_optimal"]
    assert ROWS.median_low[FAST, "episodic"] < ROWS.median_high[FAST, "d_optimal"]
    assert np.ptp(ROWS["median"][FIT]) < 1e-5
