"""The report as one page of Markdown, with its picture and its numbers beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from analysis.figures.style import environment_title
from analysis.numbers import but_lost, number, p_text, plus_minus, steps_text, within
from analysis.report.numbers import LEVEL, verdict
from analysis.report.picture import CAPTION
from analysis.sheets import Sheet

HEADERS = (
    "variant", "final loss", "ratio [95 %]", "adjusted p", "reachable set, ratio", "curve, ratio",
    "steps to ε", "coverage", "control cost, ratio", "plan [µs]", "learn [µs]", "n",
)  # fmt: skip

EXPLAINED = (
    "Ratio: variant / D-optimal inputs (the first row of a table), below 1 the variant is better; "
    "the comparison tables of the figures have it the other way, D-optimal / baseline. It is the "
    "geometric mean over shared seeds, of losses and of control costs alike. Interval: paired BCa "
    "bootstrap of the log ratio, Student's for few pairs. Adjusted p: two-sided Wilcoxon "
    "signed-rank test of the final losses, adjusted over all rows of the report "
    "(Benjamini-Hochberg). Curve: the loss over all steps (geometric mean). Steps to ε: median "
    "number of inputs until the loss first is at most ε, the median final loss of random inputs; "
    "trials that never get there count as later. Coverage: share of the cells of the phase "
    "plane's box that a trial visits, mean ± 2 standard errors. Control cost: of an episode with "
    "the model learned until the first assessment of the task, as a ratio too; lost: pairs "
    "without a ratio, as one of the episodes or the true model's has no finite cost. "
    "Microseconds: median over all steps and trials, on the machine that ran them, the update of "
    "the information matrix with the plan. n: trials that did not diverge; diverged ones are in "
    "no mean and in no ratio."
)

Row = Mapping[str, object]


def write(
    table: pd.DataFrame, notes: Sequence[str], origin: str, picture: str, more: Sequence[str] = ()
) -> str:
    """Return the page of a table of :func:`analysis.report.numbers.adjust`.

    ``more`` are further sections, already in Markdown.
    """
    parts = {str(env): _rows(part) for env, part in table.groupby("env", sort=False)}
    sections = [
        "# Every variant against D-optimal inputs",
        origin,
        "## What was found",
        "\n".join(_finding(env, rows) for env, rows in parts.items()),
        f"![Ratios of final losses]({picture})\n\n{CAPTION}",
        *(f"## {environment_title(env)}\n\n{_sheet(rows)}" for env, rows in parts.items()),
        *more,
        f"## How to read it\n\n{EXPLAINED}",
    ]
    if notes:
        sections.append("## Left out\n\n" + "\n".join(f"- {note}" for note in notes))
    return "\n\n".join(sections) + "\n"


def _rows(part: pd.DataFrame) -> list[Row]:
    return [{str(key): value for key, value in row.items()} for row in part.to_dict("records")]


def _finding(env: str, rows: Sequence[Row]) -> str:
    """Return what is better, what worse, and what the test does not tell apart, the best first."""
    judged: dict[str, list[str]] = {"better": [], "worse": [], "open": []}
    for row in sorted(rows[1:], key=lambda row: _number(row, "loss_ratio")):
        words = f"{row['variant']} ({number(_number(row, 'loss_ratio'))})"
        judged[verdict(row)].append(words)
    names = {"better": "better", "worse": "worse", "open": "not told apart"}
    said = [f"  - {names[kind]}: {'; '.join(found) or 'none'}" for kind, found in judged.items()]
    return "\n".join([f"- **{environment_title(env)}** (ratio, p < {LEVEL})", *said])


def _sheet(rows: Sequence[Row]) -> str:
    table = Sheet(HEADERS, [_cells(row) for row in rows]).markdown()
    epsilon = _number(rows[0], "epsilon")
    return table if math.isnan(epsilon) else f"ε = {number(epsilon)}\n\n{table}"


def _cells(row: Row) -> list[object]:
    def ratio(measure: str) -> str:
        columns = (f"{measure}_{name}" for name in ("ratio", "low", "high"))
        return within(*(_number(row, column) for column in columns))

    diverged = f", {row['n_diverged']} diverged" if row["n_diverged"] else ""
    return [
        row["variant"],
        plus_minus(_number(row, "loss"), _number(row, "loss_2se")),
        ratio("loss"),
        p_text(_number(row, "loss_p_adjusted")),
        ratio("reachable_loss"),
        ratio("auc"),
        steps_text(_number(row, "steps"), int(_number(row, "horizon"))),
        plus_minus(_number(row, "coverage"), _number(row, "coverage_2se")),
        but_lost(ratio("control"), int(_number(row, "control_lost"))),
        number(_number(row, "plan_us")),
        number(_number(row, "learn_us")),
        f"{row['n']}{diverged}",
    ]


def _number(row: Row, column: str) -> float:
    value = row[column]
    return float(value) if isinstance(value, int | float) else float("nan")
