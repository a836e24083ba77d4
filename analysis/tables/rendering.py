"""Tables as a person reads them, in Markdown or LaTeX."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd
from tabulate import tabulate

from analysis.gaps import Gap
from analysis.measures import Measure
from analysis.numbers import but_lost, number, p_text, plus_minus, share, steps_text, within
from analysis.paired import FEW

_LATEX = {"±": r"$\pm$", "–": "--", "≤": r"$\leq$", "ε": r"$\varepsilon$"}


@dataclass(frozen=True)
class Sheet:
    """A table of texts with a note that says what it holds."""

    headers: Sequence[str]
    rows: Sequence[Sequence[object]]
    note: str = ""

    def markdown(self) -> str:
        """Return the table and its note."""
        table = tabulate(self.rows, headers=self.headers, tablefmt="github", disable_numparse=True)
        return f"{table}\n\n{self.note}\n" if self.note else table

    def latex(self) -> str:
        """Return a ``tabular`` of the package booktabs, the note as a comment above it."""
        table = tabulate(
            self.rows, headers=self.headers, tablefmt="latex_booktabs", disable_numparse=True
        )
        for letter, command in _LATEX.items():
            table = table.replace(letter, command)
        return f"% {self.note}\n{table}\n"


def summary_sheet(table: pd.DataFrame, rule: str) -> Sheet:
    """Return the table of final losses: mean ± 2 SE, median, IQM and n."""
    rows = [
        [
            row["env"],
            row["policy"],
            plus_minus(row["loss"], row["loss_2se"]),
            number(row["loss_median"]),
            number(row["loss_iqm"]),
            plus_minus(row["reachable_loss"], row["reachable_loss_2se"]),
            row["n"],
            row["n_diverged"],
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env", "policy", "final loss", "median", "IQM", "final reachable-set loss", "n", "diverged",
    ]  # fmt: skip
    note = (
        "Loss: mean ± 2 standard errors over n trials; IQM: mean of the middle half. "
        f"Diverged trials: {rule}."
    )
    return Sheet(headers, rows, note)


_JUDGED = {
    Measure.FINAL: "final loss",
    Measure.AUC: "loss over the whole curve (geometric mean over the steps)",
}
_DIRECTION = "below 1 D-optimal is better (a report has it the other way, variant / D-optimal)"
_TESTED = "then adjusted over the table (Benjamini-Hochberg)"


def comparison_sheet(table: pd.DataFrame, rule: str, measure: Measure = Measure.FINAL) -> Sheet:
    """Return the paired comparison of losses."""
    rows = [
        [
            row["env"],
            row["baseline"],
            within(row["ratio"], row["low"], row["high"]),
            *_test_cells(row),
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env", "baseline", "loss ratio [95 %]", "P(improvement)", "Wilcoxon p", "BH-adjusted p",
        "pairs",
    ]  # fmt: skip
    note = (
        f"Ratio: D-optimal / baseline, {_DIRECTION}; geometric mean over seeds of the "
        f"{_JUDGED[measure]}; interval: paired BCa bootstrap of the log ratio, Student's below "
        f"{FEW} pairs. P(improvement): share of seeds with the lower loss, ties half. "
        f"p: two-sided Wilcoxon signed-rank test of the log ratio, {_TESTED}. "
        f"Diverged trials: {rule}."
    )
    return Sheet(headers, rows, note)


def control_sheet(table: pd.DataFrame) -> Sheet:
    """Return the paired comparison of the costs of control, with the shares of successes."""
    rows = [
        [
            row["env"],
            row["t"],
            row["baseline"],
            share(row["success"]),
            share(row["success_baseline"]),
            but_lost(within(row["ratio"], row["low"], row["high"]), row["n_lost"]),
            *_test_cells(row),
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env", "explored steps", "baseline", "success", "success of baseline",
        "cost ratio [95 %]", "P(improvement)", "Wilcoxon p", "BH-adjusted p", "pairs",
    ]  # fmt: skip
    note = (
        "Success: share of the episodes of D-optimal and of the baseline that succeed, planned by "
        f"the model learned so far. Cost ratio: D-optimal / baseline, {_DIRECTION}; geometric mean "
        "over seeds of the episode's cost; interval: paired BCa bootstrap of the log ratio, "
        f"Student's below {FEW} pairs. P(improvement): share of seeds with the lower cost, "
        f"ties half. p: two-sided Wilcoxon signed-rank test of the log ratio, {_TESTED}. "
        "Lost: pairs in no ratio, as one of the two episodes or the true model's has "
        "no finite cost; a lost episode counts as the worst in P(improvement) and p, one "
        "whose true model's was lost in neither. Trials that diverged before a step are left out."
    )
    return Sheet(headers, rows, note)


def race_sheet(table: pd.DataFrame, rule: str) -> Sheet:
    """Return the paired comparison of the steps to a loss."""
    rows = [
        [
            row["env"],
            row["baseline"],
            number(row["epsilon"]),
            steps_text(row["median"], row["horizon"]),
            steps_text(row["median_baseline"], row["horizon"]),
            f"{row['reached']}/{row['n_pairs']}",
            f"{row['reached_baseline']}/{row['n_pairs']}",
            *_test_cells(row),
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env", "baseline", "ε", "steps", "steps of baseline", "reached", "baseline reached",
        "P(earlier)", "sign p", "BH-adjusted p", "pairs",
    ]  # fmt: skip
    note = (
        "Steps: median number of inputs until the loss first is at most ε, of D-optimal and of the "
        "baseline, over shared seeds (of an even number the upper one of two); ε: median final "
        "loss of random inputs unless --epsilon says otherwise. A trial that never gets there is "
        "censored at the horizon: later than any that does, a tie with another such. P(earlier): "
        "share of seeds on which D-optimal is earlier, "
        f"ties half. p: two-sided sign test, {_TESTED}. Diverged trials: {rule}."
    )
    return Sheet(headers, rows, note)


def _test_cells(row: Mapping[Hashable, Any]) -> list[str]:
    """Return the share of seeds on which the reference is better, p, adjusted p, and the pairs.

    With the number of pairs comes how many trials of the two policies diverged, if any.
    """
    diverged = f", {row['n_diverged']} diverged" if row["n_diverged"] else ""
    pairs = f"{row['n_pairs']}{diverged}"
    return [share(row["improvement"]), p_text(row["p_value"]), p_text(row["p_adjusted"]), pairs]


def gaps_sheet(gaps: Iterable[Gap]) -> Sheet:
    """Return the table of what is missing."""
    rows = [[gap.env, gap.policy, len(gap.seeds), gap.states, gap.describe_seeds()] for gap in gaps]
    return Sheet(["env", "policy", "missing", "state", "seeds"], rows)
