"""The tables and the sentences about the swing-up are those of the CSV files beside them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.formatting import number, p_text, share, steps_text
from studies.yardsticks.swing_up import tables, tabulate
from tests.pages import DOCS, PAGES

PAGE = PAGES["docs/yardsticks.md"]
WORDS = " ".join(PAGE.split())
COLUMNS = ["env", "model", "policy"]
TABLE = pd.read_csv(DOCS / "yardsticks/flex_table1.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/flex_table1_trials.csv")
ROWS = TABLE.set_index(COLUMNS).sort_index()
N = int(ROWS.n.iloc[0])
PENDULUM, LINEAR, CARTPOLE = ("pendulum", "mlp"), ("pendulum", "linear"), ("cartpole", "mlp")
TIMES = pd.read_csv(DOCS / "pareto/figure6_pareto.csv").set_index(["env", "label"]).us_per_step


def shown(column: tuple[str, str], policy: str) -> str:
    row = ROWS.loc[(*column, policy)]
    ends = [
        steps_text(row[name], int(row.horizon))
        for name in ("samples", "samples_low", "samples_high")
    ]
    return f"{ends[0]} [{ends[1]}, {ends[2]}]"


def beside_random(column: tuple[str, str], policy: str) -> str:
    row = ROWS.loc[(*column, policy)]
    return f"{share(row.improvement)} of the seeds, p = {p_text(row.p_adjusted)}"


def test_the_tables_of_the_page_are_those_of_the_command() -> None:
    for table in tables(TABLE):
        assert table.markdown() in PAGE


def test_the_rows_follow_from_the_trials() -> None:
    found = tabulate(TRIALS).set_index(COLUMNS).sort_index()
    assert found.to_numpy(float) == pytest.approx(ROWS.to_numpy(float), rel=1e-9, nan_ok=True)
    assert f"{N} paired seeds" in WORDS
    for _, part in TRIALS.groupby(COLUMNS):
        assert sorted(part.seed) == list(range(100, 100 + N))


def test_the_sentences_name_the_numbers_of_the_table() -> None:
    planned, white = shown(CARTPOLE, "d_optimal"), shown(CARTPOLE, "random")
    better = beside_random(CARTPOLE, "d_optimal")
    assert f"cartpole: holds, {planned} against {white}, fewer on {better}" in WORDS
    assert f"pendulum: cannot be told, {beside_random(PENDULUM, 'd_optimal')}" in WORDS
    left = [N - solved(CARTPOLE, policy) for policy in ("d_optimal", "episodic")]
    assert (
        f"on the cartpole {planned} and {shown(CARTPOLE, 'episodic')}, where {left[0]} and "
        f"{left[1]} of {N} trials are not solved,"
    ) in WORDS
    assert f"with {N - left[0]} (`d_optimal`) and {N - left[1]} (`episodic`) of {N} models" in WORDS
    both = [shown(PENDULUM, policy) for policy in ("d_optimal", "episodic")]
    assert f"on the pendulum {both[0]} and {both[1]} |" in WORDS
    assert (
        f"does not hold: {shown(PENDULUM, 'random')}, and {solved(PENDULUM, 'random')} of" in WORDS
    )
    assert f"up to 1,000: {N - solved(CARTPOLE, 'random')} of {N} trials are not" in WORDS
    assert f"| {shown(LINEAR, 'd_optimal')} with a model of its kind, and so do random" in WORDS
    best = f"{shown(PENDULUM, 'uniform')}, fewer on {beside_random(PENDULUM, 'uniform')}"
    assert f"random inputs: {best}." in WORDS
    held = (
        f"{solved(CARTPOLE, 'random_held')} of {N} trials are solved at the end, fewer samples on "
    )
    assert held + beside_random(CARTPOLE, "random_held") in WORDS
    first = N - ROWS.first_unsolved[(*CARTPOLE, "uniform")]
    assert f"{first} of {N} models of `uniform`" in WORDS
    assert f"at some time, and {solved(CARTPOLE, 'uniform')} at the end" in WORDS


def solved(column: tuple[str, str], policy: str) -> int:
    row = ROWS.loc[(*column, policy)]
    return int(row.n - row.samples_unsolved)


def test_the_times_are_those_of_the_front() -> None:
    learners = {"pendulum": "gauss_newton", "cartpole": "gauss_newton, refit_every=10"}
    ratios = [
        number(TIMES[env, f"D-optimal, {learner}"] / TIMES[env, f"random, {learner}"])
        for env, learner in learners.items()
    ]
    assert f"the learner's; {ratios[0]} and {ratios[1]} times" in WORDS


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
