"""Table of error budgets."""

from __future__ import annotations

import pandas as pd

from analysis.figures.error_budget.data import PARTS
from analysis.formatting import within
from analysis.stats.intervals import STUDENT_RANGE
from analysis.tables.rendering import TextTable


def budget_table(table: pd.DataFrame) -> TextTable:
    """Return the budgets of :func:`analysis.figures.error_budget.data.tabulate` as texts."""
    rows = [
        [
            row["env"],
            row["label"],
            *(within(row[name], row[f"{name}_low"], row[f"{name}_high"]) for name in PARTS),
            f"{row['n']}, {row['n_unconverged']} not converged"
            if row["n_unconverged"]
            else row["n"],
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env", "variant", "floor", "× exploration", "= offline fit", "× learner", "= online", "n",
    ]  # fmt: skip
    note = (
        "Losses on the grid, geometric means over n trials with 95 % intervals (BCa bootstrap of "
        f"the mean logarithm, {STUDENT_RANGE} trials). Floor: offline "
        "fit to samples spread uniformly over the evaluation box. Offline fit: of the recorded "
        "samples."
    )
    return TextTable(headers, rows, note)
