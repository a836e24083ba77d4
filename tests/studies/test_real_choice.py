"""Segments of a real run by choice and at random: the stored rows, and a short run of it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import dopt
from studies.real import choice
from studies.real.__main__ import CASES, parts
from tests.paths import ROOT

DATA = os.environ.get("DOPT_DATA")


def test_the_page_has_the_table_of_the_stored_rows() -> None:
    rows = pd.read_csv(choice.STORED)
    assert rows.groupby("parameters").seed.nunique().to_dict() == {6: 20, 47: 20}
    page = (ROOT / "studies/real/README.md").read_text()
    assert choice.table(rows).markdown().strip() in page


def test_the_first_segment_at_which_an_error_is_reached_counts() -> None:
    assert choice.reached(np.array([0.3, 0.1, 0.2, 0.05]), 0.1) == 2
    assert choice.reached(np.array([0.3, np.inf]), 0.1) == 3, "never: one more than all"


def test_a_ratio_is_paired() -> None:
    """Seeds of other difficulty: each halves the number, whatever it is."""
    rows = [
        {"seed": s, "parameters": 6, "segments": n, "all": 1.0}
        | {by: 1.0 if n >= at else 2.0 for by, at in (("chosen", 3 * s), ("random", 6 * s))}
        for s in (1, 2, 4)
        for n in range(1, 31)
    ]
    line = choice.table(pd.DataFrame(rows)).rows[0]
    assert line[2:] == ["6", "12", "0.500 [0.500, 0.500]", "3, 0, 0"]


@pytest.mark.skipif(DATA is None, reason="DOPT_DATA names no folder of recorded runs")
def test_a_short_run_begins_alike_and_gets_better() -> None:
    assert DATA
    blocks = parts("disk", Path(DATA)).values()
    logs = [dopt.Log.for_plant(part, choice.PLANT, CASES["disk"].columns) for part in blocks]
    found = choice.curves(logs, 1, 0, pool=12, most=5)
    assert found.segments.to_list() == [1, 2, 3, 4, 5]
    assert (found.parameters == 6).all()
    first, last = found.iloc[0], found.iloc[-1]
    assert first.chosen == first.random
    assert last.chosen < 0.06
    assert last["all"] < 0.06
