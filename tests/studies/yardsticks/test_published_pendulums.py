"""Rows about published numbers follow from their trials, and the claims from the rows."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from studies.yardsticks.common import exponent
from studies.yardsticks.pendulums import (
    tabulate,
)
from tests.pages import DOCS

TABLE = pd.read_csv(DOCS / "yardsticks/flex_table3.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/flex_table3_trials.csv")
ROWS = TABLE.set_index(["policy", "n_pendulums"]).sort_index()


@pytest.mark.parametrize("policy", ["random", "episodic"])
def test_the_rows_follow_from_the_trials(policy: str) -> None:
    own = TRIALS[TRIALS.policy.isin({policy, "random"}) & (TRIALS.n_pendulums != 50)]
    found = tabulate(own).set_index(["policy", "n_pendulums"])
    for size in (2, 5, 10, 20):
        columns = ["n", "reached", "median", "median_low", "median_high", "ratio", "ratio_low"]
        expected = ROWS.loc[(policy, size), columns].to_numpy(float)
        assert found.loc[(policy, size), columns].to_numpy(float) == pytest.approx(
            expected, rel=1e-12, nan_ok=True
        )


@pytest.mark.parametrize("policy", ["d_optimal", "exact"])
def test_exponents_follow_from_the_trials(policy: str) -> None:
    own = TRIALS[TRIALS.policy == policy]
    by_size = {int(n): part.samples.to_numpy(float) for n, part in own.groupby("n_pendulums")}
    columns = ["exponent", "exponent_low", "exponent_high"]
    found = exponent(by_size, np.random.default_rng(20_230_426))
    assert found == pytest.approx(ROWS.loc[(policy, 50), columns].to_numpy(float), rel=1e-12)


def test_all_trials_but_two_reach_the_error_on_the_same_seeds() -> None:
    lost = TRIALS[~np.isfinite(TRIALS.samples)]
    assert set(zip(lost.policy, lost.n_pendulums, strict=True)) == {
        ("random", 50),
        ("d_optimal", 50),
    }
    assert len(lost) == 2
    for (policy, size), part in TRIALS.groupby(["policy", "n_pendulums"]):
        seeds = 10 if (policy, size) == ("episodic", 50) else 100
        assert sorted(part.seed) == list(range(100, 100 + seeds))


def test_the_claims_are_decided_by_the_intervals() -> None:
    ratios = ROWS.drop(index="random", level="policy")
    assert (ratios.loc[["exact", "episodic"], "ratio_high"] < 1.0).all()
    drawn = ratios.loc["d_optimal"]
    assert (drawn.ratio_high.drop(50) < 1.0).all()
    assert drawn.ratio_high[50] > 1.0
    assert (ratios.ratio_low > 0.5).all()
    assert ROWS.exponent_low.loc[("exact", 50)] > ROWS.exponent_high.loc[("random", 50)]
    assert ROWS.ratio_high.loc[("random_held", 50)] < ROWS.ratio_low.loc[("exact", 50)]
    behind = (ROWS.ratio.loc["random_held"] / ROWS.ratio.loc["exact"]).drop(50)
    assert 1.0 <= behind.min() < behind.max() < 1.07
    assert ROWS.median_high.loc[("episodic", 50)] < ROWS.median_low.loc[("exact", 50)]
    gaps = ROWS.loc["episodic", "median"] - ROWS.loc["exact", "median"]
    assert gaps.drop(50).abs().max() <= 2
