"""Rows about the unbalanced disk follow from their trials, and the claims from the rows."""

from __future__ import annotations

import pandas as pd
import pytest

from studies.yardsticks.disk import TARGET, tabulate
from tests.pages import DOCS

TABLE = pd.read_csv(DOCS / "yardsticks/active_sysid.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/active_sysid_trials.csv")
ROWS = TABLE.set_index(["enforced", "policy"]).sort_index()


def test_the_rows_follow_from_the_trials() -> None:
    found = tabulate(TRIALS).set_index(["enforced", "policy"]).sort_index()
    assert found.to_numpy(float) == pytest.approx(ROWS.to_numpy(float), rel=1e-9, nan_ok=True)
    assert (ROWS.n == 20).all()
    for _, part in TRIALS.groupby(["enforced", "policy"]):
        assert sorted(part.seed) == list(range(100, 120))


def test_the_claims_are_decided_by_the_intervals() -> None:
    medians, ratios = ROWS["median"], ROWS.ratio
    reached = ROWS.reached[True]
    assert reached["d_optimal"] == reached["random_held"] == 20
    assert (ROWS.median_high[True][["d_optimal", "random_held"]] < TARGET).all()
    assert ROWS.median_low[True, "random"] > TARGET
    assert (ROWS.ratio_low[:, "idw"] > 1.0).all()
    assert (ROWS.ratio_low[:, "gsx"] > 1.0).all()
    assert ROWS.ratio_high[True, "d_optimal"] < 1.0 < ROWS.ratio_low[False, "d_optimal"]
    assert medians[True].idxmin() == ratios[True].idxmin() == "random_held"
    assert medians[False].idxmin() == "random"
    assert ROWS.turned[True].idxmax() == "random_held"
