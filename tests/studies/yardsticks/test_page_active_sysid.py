"""The tables and the sentences about the unbalanced disk are those of the CSV files beside them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.formatting import within
from dopt.forecasts import true_forecast
from studies.yardsticks.disk import TARGET, run_of_the_test, tables, tabulate
from tests.dopt.trials import trial
from tests.pages import DOCS, PAGES

PAGE = PAGES["docs/yardsticks.md"]
WORDS = " ".join(PAGE.split())
TABLE = pd.read_csv(DOCS / "yardsticks/active_sysid.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/active_sysid_trials.csv")
ROWS = TABLE.set_index(["enforced", "policy"]).sort_index()


def shown(policy: str, name: str, *, enforced: bool) -> str:
    row = ROWS.loc[(enforced, policy)]
    return within(row[name], row[f"{name}_low"], row[f"{name}_high"])


def test_the_tables_of_the_page_are_those_of_the_command() -> None:
    for table in tables(TABLE):
        assert table.markdown() in PAGE


def test_the_rows_follow_from_the_trials() -> None:
    found = tabulate(TRIALS).set_index(["enforced", "policy"]).sort_index()
    assert found.to_numpy(float) == pytest.approx(ROWS.to_numpy(float), rel=1e-9, nan_ok=True)
    assert (ROWS.n == 20).all()
    for _, part in TRIALS.groupby(["enforced", "policy"]):
        assert sorted(part.seed) == list(range(100, 120))


def test_the_sentences_name_the_numbers_of_the_table() -> None:
    for policy in ("d_optimal", "random_held"):
        holds = f"{shown(policy, 'median', enforced=True)} with `{policy}`, in"
        assert f"{holds} {ROWS.reached[True, policy]} of 20" in WORDS
    assert f"`random` ends at {shown('random', 'median', enforced=True)} |" in WORDS
    for policy in ("idw", "gsx", "d_optimal"):
        for enforced in (False, True):
            assert shown(policy, "ratio", enforced=enforced) in WORDS
    assert f"random inputs end at {shown('random', 'median', enforced=False)}." in WORDS
    held, white, planned = (ROWS.turned[True, p] for p in ("random_held", "random", "d_optimal"))
    assert f"turn it by {held:.1f} rad (median" in WORDS
    assert f"end at {shown('random_held', 'ratio', enforced=True)}, D-optimal ones" in WORDS
    assert f"ones turn it by {planned:.2f} rad and random ones by {white:.2f} rad" in WORDS
    worst = 100 * ROWS.violations[True].max()
    assert f"beyond the bound after at most {worst:.1f} % of the steps" in WORDS


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


def test_the_test_run_is_as_fast_as_the_page_says() -> None:
    env = {"dt": 0.025, "integrator": "rk4", "measured_states": [1], "measurement_noise": [0.045]}
    env["initial_state"] = [0.0, 0.0]
    system = trial("unbalanced_disk", "random", 0, env=env, learner={"name": "joint_ekf"}).system
    inputs, rates = run_of_the_test(system)
    angles = true_forecast(system)(np.zeros((1, 2)), inputs)[:, 0, 0]
    assert f"turns by up to {np.abs(angles).max():.1f} rad" in WORDS
    assert f"In {100 * np.mean(np.abs(rates) > 4.5):.0f} % of the samples" in WORDS
    assert f"{np.sqrt(np.mean(rates**2)):.1f} rad/s" in WORDS
