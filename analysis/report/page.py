"""The report as one page of Markdown, with its pictures and its numbers beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from analysis.formatting import but_lost, number, p_text, plus_minus, share, steps_text, within
from analysis.line_styles import environment_title
from analysis.report.variant_table import SAME, SIGNIFICANCE, verdict
from analysis.stats.intervals import STUDENT_RANGE
from analysis.tables.rendering import TextTable
from dopt.policies import POLICIES

LOSSES = (
    "variant", "final loss", "ratio [95 %]", "adjusted p", "same setting, ratio", "adjusted p",
    "reachable set, ratio", "curve, ratio", "n",
)  # fmt: skip
EFFORT = (
    "variant", "steps to ε (share)", "adjusted p", "coverage", "control cost, ratio", "plan [µs]",
    "learn [µs]", "runs on",
)  # fmt: skip

CAPTION = (
    "Ratio of final losses, variant / reference: left of the line, below 1, the variant is "
    "better. Geometric mean over shared seeds with its 95 % interval, the best at the top. "
    "Circles: better, squares: worse, diamonds: not told apart, as the adjusted p is not below "
    f"{SIGNIFICANCE} or the interval holds 1. The oracle, which knows the form of the physics and "
    "is orders of magnitude below, is in the tables alone."
)
"""Caption of the picture of a system."""

EXPLAINED = (
    "Final loss: root mean square error of the learned accelerations over the evaluation grid "
    "after the last step, in their units, mean ± 2 standard errors.",
    "Ratio: variant / reference (the first row of a table), below 1 the variant is better: the "
    "geometric mean over shared seeds, of losses and of control costs alike, with its unadjusted "
    f"95 % interval: paired BCa bootstrap of the log ratio, {STUDENT_RANGE} "
    "pairs. Reachable set: of the final loss over states that the true "
    "system visits under strong inputs; where it and the grid disagree, the order of two variants "
    "depends on where a model is judged. Curve: "
    "of the loss over all steps (geometric mean).",
    "Adjusted p: two-sided Wilcoxon signed-rank test of the final losses, sign test of the steps; "
    "the false discovery rate over all rows of the report, for each measure (Benjamini-Hochberg). "
    "Few pairs bound it from below: 20 allow 2e-6 before it is adjusted. The test is of ranks and "
    "the interval of the mean: they need not agree, and a variant is called better or worse only "
    "where both say so.",
    "Steps to ε: median number of inputs after which the loss stays at most ε, the median final "
    "loss of random inputs, and the share of trials that get there; others count as later.",
    "Coverage: share of the cells of the phase plane's box that a trial visits, mean ± 2 standard "
    "errors. Control cost: of an episode with the model learned until the first assessment after "
    "explored steps, as a ratio too; – where the variant was not assessed. Lost: pairs without a "
    "ratio, as one of the episodes or the true model's has no finite cost.",
    "Microseconds: median over all steps and trials, on the machine that ran them, the update of "
    "the information matrix with the plan; a plan is in time for real where both together are "
    "below dt. Runs on: the compiled kernel, or the torch reference, whose microseconds are those "
    "of an implementation that nobody made fast.",
    "Same setting: the ratio to the reference policy with the variant's own model and learner, its "
    "adjusted p beside it; – where that is the reference itself or was not run.",
    "n: trials that did not diverge; by default diverged ones are in no mean and in no ratio.",
)

Row = Mapping[str, object]


def write(
    table: pd.DataFrame,
    notes: Sequence[str],
    origin: str,
    pictures: Mapping[str, str],
    more: Sequence[str] = (),
) -> str:
    """Return the page of a table of :func:`analysis.report.variant_table.adjust`.

    ``pictures`` are files, without their ending, by environment, and ``more`` further sections,
    already in Markdown.
    """
    parts = {str(env): _rows(part) for env, part in table.groupby("env", sort=False)}
    sections = [
        f"# Every variant against {table['variant'].iloc[0]}",
        origin,
        "## What was found",
        "\n".join(_finding(env, rows) for env, rows in parts.items()),
        "## How to read it",
        "\n\n".join((*EXPLAINED, f"Pictures: {CAPTION}")),
        "## What was compared",
        _described(table),
        *(_section(env, rows, pictures.get(env)) for env, rows in parts.items()),
        *more,
    ]
    if notes:
        sections.append("## Notes\n\n" + "\n".join(f"- {note}" for note in notes))
    return "\n\n".join(sections) + "\n"


def _rows(part: pd.DataFrame) -> list[Row]:
    return [{str(key): value for key, value in row.items()} for row in part.to_dict("records")]


def _finding(env: str, rows: Sequence[Row]) -> str:
    """Return what is better, what worse, and what is not told apart, the best first."""
    said = [f"  - {line}" for line in _judged(rows[1:], "loss")]
    for reference, same in _same_settings(rows).items():
        said += [f"  - against {reference}, {line}" for line in _judged(same, f"{SAME}_loss")]
    turned = [
        f"{row['variant']} ({number(_number(row, 'reachable_loss_ratio'))})"
        for row in rows[1:]
        if {verdict(row), verdict(row, "reachable_loss")} == {"better", "worse"}
    ]
    if turned:
        said.append(f"  - the other way round on the reachable set: {'; '.join(turned)}")
    return "\n".join([f"- **{environment_title(env)}** (ratio, p < {SIGNIFICANCE})", *said])


def _judged(rows: Sequence[Row], measure: str) -> list[str]:
    """Return which rows are better, worse and not told apart, the best first."""
    judged: dict[str, list[str]] = {"better": [], "worse": [], "open": []}
    for row in sorted(rows, key=lambda row: _number(row, f"{measure}_ratio")):
        words = f"{row['variant']} ({number(_number(row, f'{measure}_ratio'))})"
        judged[verdict(row, measure)].append(words)
    names = {"better": "better", "worse": "worse", "open": "not told apart"}
    return [f"{names[kind]}: {'; '.join(found) or 'none'}" for kind, found in judged.items()]


def _same_settings(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows by the reference of their own setting, those of the first row left out."""
    groups: dict[str, list[Row]] = {}
    for row in rows[1:]:
        reference = str(row[f"{SAME}_reference"])
        if reference not in ("", rows[0]["variant"]):
            groups.setdefault(reference, []).append(row)
    return groups


def _described(table: pd.DataFrame) -> str:
    """Return what each policy of the package does, in the words of its class."""
    labels = dict(zip(table["policy"], table["policy_label"], strict=True))
    lines = [
        f"- {label}: {_summary(POLICIES[policy])}"
        for policy, label in labels.items()
        if policy in POLICIES
    ]
    return "\n".join(lines)


def _summary(policy: type) -> str:
    return (policy.__doc__ or "").strip().splitlines()[0]


def _section(env: str, rows: Sequence[Row], picture: str | None) -> str:
    title = environment_title(env)
    epsilon, dt = _number(rows[0], "epsilon"), _number(rows[0], "dt")
    facts = f"{rows[0]['horizon']} steps of dt = {1e3 * dt:g} ms."
    if not math.isnan(epsilon):
        facts += f" ε = {number(epsilon)}."
    parts = [f"## {title}", facts]
    if picture is not None:
        parts.append(f"![Ratios of final losses: {title}]({picture}.png)")
    parts.append(TextTable(LOSSES, [_losses(row) for row in rows]).markdown())
    parts.append(TextTable(EFFORT, [_effort(row) for row in rows]).markdown())
    return "\n\n".join(parts)


def _losses(row: Row) -> list[object]:
    diverged = f", {row['n_diverged']} diverged" if row["n_diverged"] else ""
    return [
        row["variant"],
        plus_minus(_number(row, "loss"), _number(row, "loss_2se")),
        _ratio(row, "loss"),
        p_text(_number(row, "loss_p_adjusted")),
        _ratio(row, f"{SAME}_loss"),
        p_text(_number(row, f"{SAME}_loss_p_adjusted")),
        _ratio(row, "reachable_loss"),
        _ratio(row, "auc"),
        f"{row['n']}{diverged}",
    ]


def _effort(row: Row) -> list[object]:
    steps = steps_text(_number(row, "steps"), int(_number(row, "horizon")))
    reached = _number(row, "reached")
    return [
        row["variant"],
        steps if math.isnan(reached) else f"{steps} ({share(reached)})",
        p_text(_number(row, "steps_p_adjusted")),
        plus_minus(_number(row, "coverage"), _number(row, "coverage_2se")),
        but_lost(_ratio(row, "control"), int(_number(row, "control_lost"))),
        number(_number(row, "plan_us")),
        number(_number(row, "learn_us")),
        row["path"],
    ]


def _ratio(row: Row, measure: str) -> str:
    return within(*(_number(row, f"{measure}_{name}") for name in ("ratio", "low", "high")))


def _number(row: Row, column: str) -> float:
    value = row[column]
    return float(value) if isinstance(value, int | float) else float("nan")
