"""The tables and the sentences about the moving star are those of the CSV files beside them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.formatting import within
from studies.yardsticks.star import tables, tabulate
from tests.pages import DOCS, PAGES

PAGE = PAGES["docs/yardsticks.md"]
WORDS = " ".join(PAGE.split())
TABLE = pd.read_csv(DOCS / "yardsticks/flex_star.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/flex_star_trials.csv")
ROWS = TABLE.set_index(["learner", "policy"]).sort_index()
SLOW, FAST, FIT = "adam, rate 0.01", "adam, rate 0.02", "gauss_newton"


def shown(learner: str, policy: str, name: str) -> str:
    row = ROWS.loc[(learner, policy)]
    return within(row[name], row[f"{name}_low"], row[f"{name}_high"])


def test_the_tables_of_the_page_are_those_of_the_command() -> None:
    for table in tables(TABLE):
        assert table.markdown() in PAGE


def test_the_rows_follow_from_the_trials() -> None:
    found = tabulate(TRIALS).set_index(["learner", "policy"]).sort_index()
    assert found.to_numpy(float) == pytest.approx(ROWS.to_numpy(float), rel=1e-9, nan_ok=True)
    assert (ROWS.n == 100).all()
    for _, part in TRIALS.groupby(["learner", "policy"]):
        assert sorted(part.seed) == list(range(100, 200))


def test_the_sentences_name_the_numbers_of_the_table() -> None:
    assert f"{shown(SLOW, 'random', 'median')} with their learner" in WORDS
    slow, fast, fit = (shown(learner, "d_optimal", "ratio") for learner in (SLOW, FAST, FIT))
    assert f"`d_optimal` is {slow} and {fast}; does not hold with `gauss_newton`, {fit}" in WORDS
    slow, fast = (shown(learner, "d_optimal", "median") for learner in (SLOW, FAST))
    assert f"rate 0.02: {fast}; does not hold with the rate 0.01: {slow}" in WORDS
    assert f"`episodic` has the lower ratio, {shown(SLOW, 'episodic', 'ratio')}," in WORDS
    apart = [f"{ROWS.apart[FAST, policy]:.2f} m under" for policy in ("d_optimal", "random")]
    assert f"is {apart[0]} `d_optimal` and {apart[1]} `random`" in WORDS
    lost = {policy: ROWS.lost[FAST, policy] for policy in ("d_optimal", "episodic")}
    assert f"{lost['d_optimal']} of 100 trials of `d_optimal` and {lost['episodic']} of" in WORDS
    assert f"loses {ROWS.lost[FIT, 'd_optimal']} stars with `gauss_newton`" in WORDS
    assert (ROWS.lost[FIT].drop("d_optimal") == 0).all()


def test_the_claims_are_decided_by_the_intervals() -> None:
    assert ROWS.median_low[SLOW, "random"] <= 3.0 <= ROWS.median_high[SLOW, "random"]
    for learner in (SLOW, FAST):
        assert ROWS.ratio_high[learner, "d_optimal"] < 0.2
    assert ROWS.ratio_low[FIT, "d_optimal"] < 1.0 < ROWS.ratio_high[FIT, "d_optimal"]
    assert ROWS.median_high[FAST, "d_optimal"] < 1e-3 < ROWS.median_low[SLOW, "d_optimal"] / 10
    assert ROWS.ratio_high[SLOW, "episodic"] < ROWS.ratio_low[SLOW, "d_optimal"]
    assert ROWS.median_low[FAST, "episodic"] < ROWS.median_high[FAST, "d_optimal"]
    assert np.ptp(ROWS["median"][FIT]) < 1e-5
