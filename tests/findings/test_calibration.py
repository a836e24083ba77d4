"""The shares on the page of findings that intervals cover are those of their table."""

from __future__ import annotations

import pandas as pd
import pytest

from analysis.formatting import share
from dopt.systems import SYSTEMS
from tests.findings.report_columns import ALL, FINDINGS
from tests.pages import DOCS

NAMES = ["model", "learner", "policy", "env"]
TABLE = pd.read_csv(DOCS / "calibration.csv").set_index(NAMES).sort_index()
SETS = ["grid_covered", "reachable_covered"]
ROWS = [
    (model, learner, policy)
    for model, learner in (("linear", "ekf"), ("mlp", "gauss_newton"), ("mlp", "ekf"))
    for policy in ("d_optimal", "random")
]


@pytest.mark.parametrize(
    ("model", "learner", "policy"), [*ROWS, ("mlp", "adam_window", "d_optimal")]
)
def test_rows_are_those_of_the_table(model: str, learner: str, policy: str) -> None:
    cells = []
    for env in ALL:
        row = TABLE.loc[(model, learner, policy, env)]
        assert row.n == 20
        cells.append(f"{share(row.grid_covered)} / {share(row.reachable_covered)}")
    name = {"d_optimal": "D-optimal"}.get(policy, policy)
    assert f"| `{model}`, `{learner}` | {name} | {' | '.join(cells)} |" in FINDINGS


def test_the_sentences_say_what_the_table_does() -> None:
    right = TABLE.loc["linear"][SETS]
    assert f"{share(right.min().min())} to {share(right.max().max())} of them are" in FINDINGS
    assert {len(SYSTEMS[env].linear_parameters) for env in ALL} == {1, 2, 3}
    fitted = TABLE.loc[("mlp", "gauss_newton")]
    grid = [share(fitted.grid_covered["d_optimal", env]) for env in ALL]
    said = "cover {} on the grid of the pendulum, {} on that of the cartpole, {} on that of the arm"
    assert said.format(*grid) in FINDINGS
    assert (fitted.loc["d_optimal"][SETS] > fitted.loc["random"][SETS]).all(axis=None)
    others = TABLE.loc["mlp"].drop("gauss_newton")[SETS].dropna()
    assert f"cover at most {share(others.max().max())}." in FINDINGS
    assert others.max().max() < fitted[SETS].max().max()
