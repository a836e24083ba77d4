"""The tables and the sentences about published numbers are those of the CSV files beside them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.yardsticks.growth import exponent
from analysis.yardsticks.pendulum_rows import (
    ratio_table,
    samples_table,
    tabulate,
)
from tests.pages import DOCS, PAGES

PAGE = PAGES["docs/yardsticks.md"]
TABLE = pd.read_csv(DOCS / "yardsticks/flex_table3.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/flex_table3_trials.csv")
ROWS = TABLE.set_index(["policy", "n_pendulums"])


def test_the_tables_of_the_page_are_those_of_the_command() -> None:
    for table in (samples_table(TABLE), ratio_table(TABLE)):
        assert table.markdown() in PAGE


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


def test_every_trial_reaches_the_error_on_the_same_seeds() -> None:
    for (policy, size), part in TRIALS.groupby(["policy", "n_pendulums"]):
        seeds = 10 if (policy, size) == ("episodic", 50) else 100
        assert sorted(part.seed) == list(range(100, 100 + seeds))
        assert np.isfinite(part.samples).all()
