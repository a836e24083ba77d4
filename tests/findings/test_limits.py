"""The numbers on limits are those of their table."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from tests.findings.report_columns import FINDINGS
from tests.pages import DOCS

TABLE = pd.read_csv(DOCS / "limits.csv")
RUNS = [
    ("cartpole", "d_optimal", "adam_window"),
    ("cartpole", "d_optimal", "gauss_newton"),
    ("cartpole", "random", "adam_window"),
    ("cartpole", "random", "gauss_newton"),
    ("cartpole", "d_optimal", "joint_ekf"),
    ("cartpole", "random", "joint_ekf"),
    ("unbalanced_disk", "d_optimal", "gauss_newton"),
    ("unbalanced_disk", "random", "gauss_newton"),
]


def runs(env: str, policy: str, learner: str, enforced: bool) -> pd.DataFrame:
    """Return the trials of a configuration, by seed."""
    rows = TABLE[(TABLE.env == env) & (TABLE.policy == policy) & (TABLE.learner == learner)]
    return rows[rows.enforced == enforced].set_index("seed")


def geometric_mean(values: pd.Series[float]) -> float:
    return float(np.exp(np.log(values).mean()))


def share(rows: pd.DataFrame) -> float:
    """Return the share of the steps that lead beyond a bound [%]."""
    return 100 * float(rows.violations.sum() / rows.n_steps.sum())


@pytest.mark.parametrize(("env", "policy", "learner"), RUNS)
def test_rows_are_those_of_the_table(env: str, policy: str, learner: str) -> None:
    free, kept = (runs(env, policy, learner, enforced) for enforced in (False, True))
    assert len(free) == len(kept) == 100
    shares = " | ".join(f"{share(rows):.3g} %" for rows in (free, kept))
    losses = [geometric_mean(rows.final_loss) for rows in (free, kept)]
    cells = " | ".join(
        f"{value:.3g}" for value in (kept.worst.max(), *losses, losses[1] / losses[0])
    )
    assert f"| {env} | `{policy}` | `{learner}` | {shares} | {cells} |" in FINDINGS


@pytest.mark.parametrize("learner", ["adam_window", "gauss_newton", "joint_ekf"])
def test_the_rail_costs_little(learner: str) -> None:
    """At most 1 % of the steps lead beyond it, at 1.25 times the loss without limits at most."""
    free, kept = (runs("cartpole", "d_optimal", learner, enforced) for enforced in (False, True))
    assert share(kept) <= 1.0
    assert geometric_mean(kept.final_loss) <= 1.25 * geometric_mean(free.final_loss)
