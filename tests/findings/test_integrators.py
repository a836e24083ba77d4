"""The numbers under Euler and Runge-Kutta steps are those of their table."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tests.findings.report_columns import FINDINGS
from tests.pages import DOCS

TABLES = {
    name: pd.read_csv(DOCS / f"{name}.csv") for name in ("integrators", "integrators_gauss_newton")
}
SEEDS = {"integrators": 100, "integrators_gauss_newton": 10}
OTHERS = {
    "pendulum": ("random", "uniform", "periodic"),
    "cartpole": ("random", "uniform", "periodic"),
    "arm": ("random", "uniform", "periodic"),
    "quadrotor": ("random", "uniform"),
}


def gaps(table: pd.DataFrame, env: str, policy: str, integrator: str) -> pd.Series[float]:
    """Return the logarithms of a policy's final losses over those of D-optimal, by seed."""
    rows = table[(table.env == env) & (table.integrator == integrator)]
    losses = rows.pivot_table(index="seed", columns="policy", values="final_loss")
    return np.log(losses[policy] / losses.d_optimal)


def loss(table: pd.DataFrame, env: str, integrator: str) -> float:
    rows = table[(table.env == env) & (table.integrator == integrator)]
    return float(np.exp(np.log(rows[rows.policy == "d_optimal"].final_loss).mean()))


def cell(values: pd.Series[float]) -> str:
    """Return the ratio, in brackets where the paired t-test does not tell it from 1 at 1 %."""
    ratio = f"{np.exp(values.mean()):.3g}"
    return ratio if stats.ttest_1samp(values, 0.0).pvalue < 0.01 else f"({ratio})"


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("env", OTHERS)
def test_rows_are_those_of_the_table(env: str, name: str) -> None:
    table, cells = TABLES[name], []
    for policy in ("random", "uniform", "periodic"):
        if policy not in OTHERS[env]:
            cells += ["", ""]
            continue
        both = [gaps(table, env, policy, integrator) for integrator in ("euler", "rk4")]
        assert all(len(values) == SEEDS[name] for values in both)
        cells += [cell(values) for values in both]
    losses = [f"{loss(table, env, integrator):.3g}" for integrator in ("euler", "rk4")]
    row = " | ".join(word or "-" for word in (env, *losses, *cells))
    assert f"| {row} |" in FINDINGS


def test_periodic_inputs_stay_below_on_the_cartpole_alone() -> None:
    """What the page says of the ten seeds under gauss_newton."""
    table = TABLES["integrators_gauss_newton"]
    below = [
        (env, policy, integrator)
        for env, policies in OTHERS.items()
        for policy in policies
        for integrator in ("euler", "rk4")
        if gaps(table, env, policy, integrator).mean() < 0.0
    ]
    assert {(env, policy) for env, policy, _ in below} == {("cartpole", "periodic")}
