"""Rows about agents follow from their trials, and the claims from the rows."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from studies.yardsticks.swing_up import tabulate
from tests.pages import DOCS

TABLE = pd.read_csv(DOCS / "yardsticks/agents/flex_table1.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/agents/flex_table1_trials.csv")
ROWS = TABLE.set_index(["env", "policy"]).sort_index()
OWN = "sac, its own feedback"
N = 20


def test_the_rows_follow_from_the_trials() -> None:
    found = tabulate(TRIALS).set_index(["env", "policy"]).sort_index()
    numbers = [name for name in found.columns if name != "model"]
    ours, theirs = (one[numbers].to_numpy(float) for one in (found, ROWS))
    assert ours == pytest.approx(theirs, rel=1e-9, nan_ok=True)
    for _, part in TRIALS.groupby(["env", "policy"]):
        assert sorted(part.seed) == list(range(100, 100 + N))


def test_the_claims_are_decided_by_the_trials() -> None:
    own = ROWS.xs(OWN, level="policy")
    assert (own.horizon == 2000).all()
    assert np.isinf(own.samples).all()
    assert ROWS.samples["pendulum", "max_agent"] < 2000
    assert ROWS.horizon["cartpole", "max_agent"] == 1000
    assert np.isinf(ROWS.samples["cartpole", "max_agent"])
    for env in ("pendulum", "cartpole"):  # not told apart from random inputs
        assert ROWS.p_adjusted[env, "max_agent"] > 0.05
    assert ROWS.p_adjusted["cartpole", "d_optimal"] < 0.001
