"""The table of the pendulum of FLEX's example is that of the CSV file beside it."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from analysis.formatting import within
from tests.pages import DOCS, PAGES

LOSSES = pd.read_csv(DOCS / "yardsticks/flex_example.csv").pivot_table(
    index="seed", columns="policy", values="final_loss"
)
RANDOM = "random"


def shown(values: pd.Series[float]) -> str:
    """Return the geometric mean with its interval."""
    logs = np.log(values)
    half = stats.t.ppf(0.975, len(logs) - 1) * logs.sem()
    return within(*np.exp([logs.mean(), logs.mean() - half, logs.mean() + half]))


@pytest.mark.parametrize("policy", LOSSES.columns)
def test_rows_are_those_of_the_table(policy: str) -> None:
    ratio = "–" if policy == RANDOM else shown(LOSSES[policy] / LOSSES[RANDOM])
    row = f"| {policy} | {shown(LOSSES[policy])} | {ratio} |"
    assert row in PAGES["docs/yardsticks.md"]


def test_d_optimal_inputs_teach_more_than_random_ones() -> None:
    assert list(LOSSES.index) == list(range(100, 200))
    gaps = np.log(LOSSES["d_optimal"] / LOSSES[RANDOM])
    assert gaps.mean() < 0
    assert stats.ttest_1samp(gaps, 0.0).pvalue < 1e-6
