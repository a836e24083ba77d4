"""Rows about published numbers follow from their trials, and the claims from the rows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest

from analysis.style import steps_text
from studies.yardsticks import disk, pendulums, star, swing_up
from studies.yardsticks.common import exponent
from tests.pages import DOCS


def read(name: str) -> pd.DataFrame:
    return pd.read_csv(DOCS / f"yardsticks/{name}.csv")


def rows(name: str, *keys: str) -> pd.DataFrame:
    return read(name).set_index(list(keys)).sort_index()


@pytest.mark.parametrize(
    ("name", "tabulate", "keys", "seeds"),
    [
        ("active_sysid", disk.tabulate, ["enforced", "policy"], 20),
        ("agents/flex_table1", swing_up.tabulate, ["env", "policy"], 20),
        ("flex_star", star.tabulate, ["learner", "policy"], 100),
        ("flex_table1", swing_up.tabulate, ["env", "model", "policy"], 100),
    ],
)
def test_the_rows_follow_from_the_trials(
    name: str, tabulate: Callable[[pd.DataFrame], pd.DataFrame], keys: list[str], seeds: int
) -> None:
    trials, stored = read(f"{name}_trials"), rows(name, *keys)
    found = tabulate(trials).set_index(keys).sort_index()
    numbers = [column for column in found.columns if column != "model"]
    ours, theirs = (one[numbers].to_numpy(float) for one in (found, stored))
    assert ours == pytest.approx(theirs, rel=1e-9, nan_ok=True)
    assert stored.n.max() == seeds
    for _, part in trials.groupby(keys):
        assert sorted(part.seed) == list(range(100, 100 + seeds))


def test_the_claims_about_the_disk() -> None:
    table = rows("active_sysid", "enforced", "policy")
    medians, ratios, reached = table["median"], table.ratio, table.reached[True]
    assert reached["d_optimal"] == reached["random_held"] == 20
    assert (table.median_high[True][["d_optimal", "random_held"]] < disk.TARGET).all()
    assert table.median_low[True, "random"] > disk.TARGET
    assert (table.ratio_low[:, "idw"] > 1.0).all()
    assert (table.ratio_low[:, "gsx"] > 1.0).all()
    assert table.ratio_high[True, "d_optimal"] < 1.0 < table.ratio_low[False, "d_optimal"]
    assert medians[True].idxmin() == ratios[True].idxmin() == "random_held"
    assert medians[False].idxmin() == "random"
    assert table.turned[True].idxmax() == "random_held"


def test_the_claims_about_agents() -> None:
    table = rows("agents/flex_table1", "env", "policy")
    own = table.xs("sac, its own feedback", level="policy")
    assert (own.horizon == 2000).all()
    assert np.isinf(own.samples).all()
    assert table.samples["pendulum", "max_agent"] < 2000
    assert table.horizon["cartpole", "max_agent"] == 1000
    assert np.isinf(table.samples["cartpole", "max_agent"])
    for env in ("pendulum", "cartpole"):  # not told apart from random inputs
        assert table.p_adjusted[env, "max_agent"] > 0.05
    assert table.p_adjusted["cartpole", "d_optimal"] < 0.001


def test_the_claims_about_the_star() -> None:
    table = rows("flex_star", "learner", "policy")
    slow, fast, fit = "adam, rate 0.01", "adam, rate 0.02", "gauss_newton"
    assert table.median_low[slow, "random"] <= 3.0 <= table.median_high[slow, "random"]
    for learner in (slow, fast):
        assert table.ratio_high[learner, "d_optimal"] < 0.2
    assert table.ratio_low[fit, "d_optimal"] < 1.0 < table.ratio_high[fit, "d_optimal"]
    assert table.median_high[fast, "d_optimal"] < 1e-3 < table.median_low[slow, "d_optimal"] / 10
    assert table.ratio_high[slow, "episodic"] < table.ratio_low[slow, "d_optimal"]
    assert table.median_low[fast, "episodic"] < table.median_high[fast, "d_optimal"]
    assert np.ptp(table["median"][fit]) < 1e-5


def test_the_claims_about_the_swing_up() -> None:
    table = rows("flex_table1", "env", "model", "policy")
    pendulum, linear, cartpole = ("pendulum", "mlp"), ("pendulum", "linear"), ("cartpole", "mlp")

    def shown(column: tuple[str, str], policy: str) -> list[str]:
        row = table.loc[(*column, policy)]
        names = ("samples", "samples_low", "samples_high")
        return [steps_text(row[name], int(row.horizon)) for name in names]

    adjusted = table.p_adjusted
    assert adjusted[(*cartpole, "d_optimal")] < 0.001
    assert adjusted[(*pendulum, "d_optimal")] > 0.05
    told = adjusted.loc[pendulum].dropna() < 0.05
    assert list(told[told].index) == ["uniform"]
    for column in (pendulum, cartpole):
        ends = table.loc[column].loc[["d_optimal", "episodic"]]
        assert ends.samples_low.max() <= ends.samples_high.min()
    # Five trials of one policy alone: no exact test of pairs tells them from none at 0.05.
    left = table.samples_unsolved
    assert (left[(*cartpole, "d_optimal")], left[(*cartpole, "episodic")]) == (5, 0)
    assert shown(linear, "d_optimal") == shown(linear, "random")
    random = table.loc[(*cartpole, "random")]
    assert random.n - random.samples_unsolved == 1
    assert np.isinf(random.samples_low)


PENDULUMS = rows("flex_table3", "policy", "n_pendulums")
TRIALS = read("flex_table3_trials")


@pytest.mark.parametrize("policy", ["random", "episodic"])
def test_the_rows_of_pendulums_follow_from_the_trials(policy: str) -> None:
    own = TRIALS[TRIALS.policy.isin({policy, "random"}) & (TRIALS.n_pendulums != 50)]
    found = pendulums.tabulate(own).set_index(["policy", "n_pendulums"])
    columns = ["n", "reached", "median", "median_low", "median_high", "ratio", "ratio_low"]
    for size in (2, 5, 10, 20):
        ours, theirs = (
            one.loc[(policy, size), columns].to_numpy(float) for one in (found, PENDULUMS)
        )
        assert ours == pytest.approx(theirs, rel=1e-12, nan_ok=True)


@pytest.mark.parametrize("policy", ["d_optimal", "exact"])
def test_exponents_follow_from_the_trials(policy: str) -> None:
    own = TRIALS[TRIALS.policy == policy]
    by_size = {int(n): part.samples.to_numpy(float) for n, part in own.groupby("n_pendulums")}
    columns = ["exponent", "exponent_low", "exponent_high"]
    found = exponent(by_size, np.random.default_rng(20_230_426))
    expected = PENDULUMS.loc[(policy, 50), columns].to_numpy(float)
    assert found == pytest.approx(expected, rel=1e-12)


def test_all_trials_of_pendulums_but_two_reach_the_error_on_the_same_seeds() -> None:
    lost = TRIALS[~np.isfinite(TRIALS.samples)]
    kinds = sorted(zip(lost.policy, lost.n_pendulums, strict=True))
    assert kinds == [("d_optimal", 50), ("random", 50)]
    for kind, part in TRIALS.groupby(["policy", "n_pendulums"]):
        seeds = 10 if kind == ("episodic", 50) else 100
        assert sorted(part.seed) == list(range(100, 100 + seeds))


def test_the_claims_about_pendulums() -> None:
    table = PENDULUMS
    ratios = table.drop(index="random", level="policy")
    assert (ratios.loc[["exact", "episodic"], "ratio_high"] < 1.0).all()
    drawn = ratios.loc["d_optimal"]
    assert (drawn.ratio_high.drop(50) < 1.0).all()
    assert drawn.ratio_high[50] > 1.0
    assert (ratios.ratio_low > 0.5).all()
    assert table.exponent_low.loc[("exact", 50)] > table.exponent_high.loc[("random", 50)]
    assert table.ratio_high.loc[("random_held", 50)] < table.ratio_low.loc[("exact", 50)]
    behind = (table.ratio.loc["random_held"] / table.ratio.loc["exact"]).drop(50)
    assert 1.0 <= behind.min() < behind.max() < 1.07
    assert table.median_high.loc[("episodic", 50)] < table.median_low.loc[("exact", 50)]
    gaps = table.loc["episodic", "median"] - table.loc["exact", "median"]
    assert gaps.drop(50).abs().max() <= 2
