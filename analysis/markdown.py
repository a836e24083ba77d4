"""Tables as a person reads them; the CSV beside them has all digits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import pandas as pd
from tabulate import tabulate

from analysis.gaps import Gap


def number(value: float, digits: int = 3) -> str:
    """Return a number with some significant digits, a dash for NaN."""
    if math.isnan(value):
        return "–"
    if value == 0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}" if value else "0"
    places = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, places):.{max(places, 0)}f}"


def p_text(value: float) -> str:
    """Return a p-value to two significant digits, a dash for none."""
    if math.isnan(value):
        return "–"
    return f"{value:.2g}" if value >= 1e-4 else f"{value:.0e}"


def plus_minus(value: float, error: float) -> str:
    """Return ``mean ± error``, the error to two digits and the mean to the same place."""
    if not error > 0:
        return number(value)
    places = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{places}f} ± {error:.{places}f}"


def _ratio(ratio: float, low: float, high: float) -> str:
    if math.isnan(low):
        return number(ratio)
    return f"{number(ratio)} [{number(low)}, {number(high)}]"


def summary_markdown(table: pd.DataFrame) -> str:
    """Return the table of final losses: mean ± 2 SE and n."""
    rows = [
        [
            row["env"],
            row["policy"],
            plus_minus(row["loss"], row["loss_2se"]),
            plus_minus(row["reachable_loss"], row["reachable_loss_2se"]),
            row["n"],
            row["n_diverged"],
        ]
        for row in table.to_dict("records")
    ]
    headers = ["env", "policy", "final loss", "final reachable-set loss", "n", "diverged"]
    return _grid(rows, headers) + "\n\nMean ± 2 standard errors over n trials.\n"


def comparison_markdown(table: pd.DataFrame, rule: str) -> str:
    """Return the paired comparison table with a sentence that says what it holds."""
    rows = [
        [
            row["env"],
            row["baseline"],
            _ratio(row["ratio"], row["low"], row["high"]),
            "–" if math.isnan(row["improvement"]) else format(row["improvement"], ".2f"),
            p_text(row["p_value"]),
            p_text(row["p_adjusted"]),
            row["n_pairs"],
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env",
        "baseline",
        "loss ratio [95 %]",
        "P(improvement)",
        "Wilcoxon p",
        "BH-adjusted p",
        "pairs",
    ]
    note = (
        "Ratio: geometric mean over seeds of the final loss of D-optimal by that of the baseline, "
        "below 1 D-optimal is better; interval: paired BCa bootstrap. P(improvement): share of "
        "seeds with the lower loss, ties half. p: two-sided Wilcoxon signed-rank test of the log "
        "ratio, then adjusted over the table (Benjamini-Hochberg). Diverged trials: "
        f"{rule}.\n"
    )
    return f"{_grid(rows, headers)}\n\n{note}"


def gaps_markdown(gaps: Iterable[Gap]) -> str:
    """Return the table of what is missing."""
    rows = [[gap.env, gap.policy, len(gap.seeds), gap.states, gap.describe_seeds()] for gap in gaps]
    return _grid(rows, ["env", "policy", "missing", "state", "seeds"])


def _grid(rows: Sequence[Sequence[object]], headers: list[str]) -> str:
    return tabulate(rows, headers=headers, tablefmt="github", disable_numparse=True)
