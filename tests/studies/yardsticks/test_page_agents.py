"""The tables and sentences about agents of reinforcement learning are those of the CSV files."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from analysis.formatting import steps_text
from studies.yardsticks.swing_up import tables, tabulate
from tests.pages import DOCS, PAGES

PAGE = PAGES["docs/yardsticks.md"]
SECTION = PAGE.split("### Agents of reinforcement learning")[1].split("\n## ")[0]
WORDS = " ".join(SECTION.split())
TABLE = pd.read_csv(DOCS / "yardsticks/agents/flex_table1.csv")
TRIALS = pd.read_csv(DOCS / "yardsticks/agents/flex_table1_trials.csv")
ROWS = TABLE.set_index(["env", "policy"]).sort_index()
OWN = "sac, its own feedback"
N = 20


def shown(env: str, policy: str) -> str:
    row = ROWS.loc[(env, policy)]
    names = ("samples", "samples_low", "samples_high")
    ends = [steps_text(row[name], int(row.horizon)) for name in names]
    return f"{ends[0]} [{ends[1]}, {ends[2]}]"


def test_the_tables_of_the_page_are_those_of_the_command() -> None:
    for table in tables(TABLE):
        assert table.markdown() in SECTION


def test_the_rows_follow_from_the_trials() -> None:
    found = tabulate(TRIALS).set_index(["env", "policy"]).sort_index()
    numbers = [name for name in found.columns if name != "model"]
    ours, theirs = (one[numbers].to_numpy(float) for one in (found, ROWS))
    assert ours == pytest.approx(theirs, rel=1e-9, nan_ok=True)
    for _, part in TRIALS.groupby(["env", "policy"]):
        assert sorted(part.seed) == list(range(100, 100 + N))


def test_the_sentences_name_the_numbers_of_the_table() -> None:
    agent, white = shown("pendulum", "max_agent"), shown("pendulum", "random")
    assert f"does not hold: {agent}, where random inputs take {white} |" in WORDS
    lost = ROWS.samples_unsolved["cartpole"]
    assert f"{lost['max_agent']} of {N} trials are not solved, {lost['random']} with" in WORDS
    solved = N - int(ROWS.samples_unsolved["cartpole", "sac"])
    learned = f"after {shown('pendulum', 'sac')} samples and the cartpole after"
    assert f"{learned} {shown('cartpole', 'sac')}, in {solved} of {N} trials" in WORDS
    own = ROWS.samples_unsolved.xs(OWN, level="policy")
    assert f"at the end solved in {2 * N - own.sum()} of {2 * N} trials |" in WORDS


def test_the_claims_are_decided_by_the_trials() -> None:
    own = ROWS.xs(OWN, level="policy")
    assert (own.horizon == 2000).all()
    assert np.isinf(own.samples).all()
    assert ROWS.samples["pendulum", "max_agent"] < 2000
    assert ROWS.horizon["cartpole", "max_agent"] == 1000
    assert np.isinf(ROWS.samples["cartpole", "max_agent"])
    for env in ("pendulum", "cartpole"):  # not told apart from random inputs
        assert ROWS.p_adjusted[env, "max_agent"] > 0.05
    assert ROWS.p_adjusted["cartpole", "d_optimal"] < 0.001
