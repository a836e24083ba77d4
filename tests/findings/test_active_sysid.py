"""The tables and the sentences about the unbalanced disk are those of the CSV files beside them."""

from __future__ import annotations

import pandas as pd
import pytest

from analysis.formatting import within
from analysis.yardsticks.disk_rows import TARGET, tables, tabulate
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
