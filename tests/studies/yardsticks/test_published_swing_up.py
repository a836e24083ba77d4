"""Rows about the swing-up follow from their trials, and the claims from the rows."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.style import steps_text
from studies.yardsticks.swing_up import tabulate
from tests.pages import DOCS

COLUMNS = ["env", "model", "policy"]
TABLE = pd.read_csv(DOCS / "yardsticks/flex_table1.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/flex_table1_trials.csv")
ROWS = TABLE.set_index(COLUMNS).sort_index()
N = int(ROWS.n.iloc[0])
PENDULUM, LINEAR, CARTPOLE = ("pendulum", "mlp"), ("pendulum", "linear"), ("cartpole", "mlp")


def shown(column: tuple[str, str], policy: str) -> str:
    row = ROWS.loc[(*column, policy)]
    ends = [
        steps_text(row[name], int(row.horizon))
        for name in ("samples", "samples_low", "samples_high")
    ]
    return f"{ends[0]} [{ends[1]}, {ends[2]}]"


def test_the_rows_follow_from_the_trials() -> None:
    found = tabulate(TRIALS).set_index(COLUMNS).sort_index()
    assert found.to_numpy(float) == pytest.approx(ROWS.to_numpy(float), rel=1e-9, nan_ok=True)
    for _, part in TRIALS.groupby(COLUMNS):
        assert sorted(part.seed) == list(range(100, 100 + N))


def solved(column: tuple[str, str], policy: str) -> int:
    row = ROWS.loc[(*column, policy)]
    return int(row.n - row.samples_unsolved)


def test_the_claims_are_decided_by_the_intervals() -> None:
    adjusted = ROWS.p_adjusted
    assert adjusted[(*CARTPOLE, "d_optimal")] < 0.001
    assert adjusted[(*PENDULUM, "d_optimal")] > 0.05
    told = adjusted.loc[PENDULUM].dropna() < 0.05
    assert list(told[told].index) == ["uniform"]
    for column in (PENDULUM, CARTPOLE):
        ends = ROWS.loc[column].loc[["d_optimal", "episodic"]]
        assert ends.samples_low.max() <= ends.samples_high.min()
    # Five trials of one policy alone: no exact test of pairs tells them from none at 0.05.
    left = ROWS.samples_unsolved
    assert (left[(*CARTPOLE, "d_optimal")], left[(*CARTPOLE, "episodic")]) == (5, 0)
    assert shown(LINEAR, "d_optimal") == shown(LINEAR, "random")
    assert solved(CARTPOLE, "random") == 1
    assert np.isinf(ROWS.samples_low[(*CARTPOLE, "random")])
