"""Tables of the study, from its stored rows."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

ROWS = Path(__file__).with_name("rows.csv")
"""Rows of the published tables."""


def read(path: Path) -> pd.DataFrame:
    """Return the rows, one for each trial."""
    return pd.read_csv(path)


def tables(rows: pd.DataFrame) -> str:
    return str(rows.groupby(["env", "plant", "policy", "learner"]).size())
