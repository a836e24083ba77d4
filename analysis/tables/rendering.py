"""Rendering of tables as Markdown or LaTeX."""

from __future__ import annotations

import unicodedata
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd
from tabulate import tabulate

from analysis.data.missing_trials import Gap
from analysis.formatting import (
    but_diverged,
    but_lost,
    number,
    p_text,
    plus_minus,
    share,
    steps_text,
    within,
)
from analysis.stats.intervals import STUDENT_RANGE
from analysis.stats.trial_scores import Measure


@dataclass(frozen=True)
class TextTable:
    """A table of texts with a note that says what it holds."""

    headers: Sequence[str]
    rows: Sequence[Sequence[object]]
    note: str = ""

    def markdown(self) -> str:
        """Return the table and its note."""
        table = tabulate(self.rows, headers=self.headers, tablefmt="github", disable_numparse=True)
        return f"{table}\n\n{self.note}\n" if self.note else table

    def latex(self) -> str:
        """Return a whole ``tabular`` that needs no package, the note as comments above it.

        Everything is ASCII, so that it compiles with every engine.
        """
        cells = [[_latex_text(text) for text in row] for row in (self.headers, *self.rows)]
        lines = [" & ".join(row) + r" \\" for row in cells]
        note = "".join(f"% {_ascii(line)}\n" for line in self.note.splitlines())
        begin = rf"\begin{{tabular}}{{{'l' * len(self.headers)}}}"
        parts = [begin, r"\hline", lines[0], r"\hline", *lines[1:], r"\hline", r"\end{tabular}"]
        return note + "\n".join(parts) + "\n"


_ESCAPED = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_ESCAPED |= {letter: f"\\{letter}" for letter in "&%$#_{}"}
_ESCAPED |= {"<": "$<$", ">": "$>$", "|": "$|$", "[": "{[}"}
_SIGNS = {"±": r"$\pm$", "–": "--", "−": "$-$", "≤": r"$\leq$", "≥": r"$\geq$", "×": r"$\times$"}
_SIGNS |= {"ε": r"$\varepsilon$", "φ": r"$\varphi$", "µ": r"$\mu$", "²": "$^2$", "·": r"$\cdot$"}


def _latex_text(text: object) -> str:
    """Return a text as LaTeX: special letters escaped, signs and Greek letters as commands."""
    return "".join(_latex_letter(letter) for letter in str(text))


def _latex_letter(letter: str) -> str:
    if letter in _ESCAPED or letter in _SIGNS:
        return _ESCAPED.get(letter) or _SIGNS[letter]
    name = unicodedata.name(letter, "")
    if name.startswith("GREEK SMALL LETTER "):
        return rf"$\{name.rpartition(' ')[2].lower().replace('lamda', 'lambda')}$"
    return _ascii(letter)


def _ascii(text: str) -> str:
    """Return the nearest ASCII text, letters without one as their names, no combining marks."""
    return "".join(map(_ascii_letter, unicodedata.normalize("NFKD", text)))


def _ascii_letter(letter: str) -> str:
    if letter.isascii():
        return letter
    name = unicodedata.name(letter, "?").lower()
    return "" if unicodedata.combining(letter) else name.rpartition(" ")[2]


def summary_table(table: pd.DataFrame, rule: str) -> TextTable:
    """Return the table of final losses: mean ± 2 SE, median, IQM and n."""
    rows = [
        [
            row["env"],
            row["label"],
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
        "env", "variant", "final loss", "median", "IQM", "final reachable-set loss", "n",
        "diverged",
    ]  # fmt: skip
    note = (
        "Loss: mean ± 2 standard errors over n trials; IQM: mean of the middle half. "
        f"Diverged trials: {rule}."
    )
    return TextTable(headers, rows, note)


_JUDGED = {
    Measure.FINAL: "final loss",
    Measure.AUC: "loss over the whole curve (geometric mean over the steps)",
}
_RATIO = "variant / reference, below 1 the variant is better"
_TESTED = "then adjusted over the table (Benjamini-Hochberg)"


def comparison_table(table: pd.DataFrame, rule: str, measure: Measure = Measure.FINAL) -> TextTable:
    """Return the paired comparison of losses."""
    rows = [
        [
            row["env"],
            row["variant"],
            row["reference"],
            within(row["ratio"], row["low"], row["high"]),
            *_test_columns(row),
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env", "variant", _reference(table), "loss ratio [95 %]", "P(improvement)", "Wilcoxon p",
        "BH-adjusted p", "pairs",
    ]  # fmt: skip
    note = (
        f"Ratio: {_RATIO}; geometric mean over seeds of the "
        f"{_JUDGED[measure]}; interval: paired BCa bootstrap of the log ratio, {STUDENT_RANGE} "
        "pairs. P(improvement): share of seeds with the lower loss, ties half. "
        f"p: two-sided Wilcoxon signed-rank test of the log ratio, {_TESTED}. "
        f"Diverged trials: {rule}."
    )
    return TextTable(headers, rows, note)


def aggregate_table(table: pd.DataFrame, rule: str) -> TextTable:
    """Return the comparison over all systems."""
    rows = [
        [
            row["variant"],
            row["reference"],
            within(row["ratio"], row["low"], row["high"]),
            row["systems"],
            but_diverged(row["n_pairs"], row["n_diverged"]),
        ]
        for row in table.to_dict("records")
    ]
    headers = ["variant", "reference", "loss ratio [95 %]", "systems", "pairs"]
    note = (
        f"Ratio: {_RATIO}; geometric mean over systems, each counted alike, of the geometric mean "
        "over shared seeds of the final loss; interval: percentile bootstrap over pairs, "
        "stratified by system. Compare only rows of the same systems. "
        f"Diverged trials: {rule}."
    )
    return TextTable(headers, rows, note)


def control_table(table: pd.DataFrame) -> TextTable:
    """Return the paired comparison of the costs of control, with the shares of successes."""
    rows = [
        [
            row["env"],
            row["t"],
            row["variant"],
            row["reference"],
            share(row["success"]),
            share(row["success_reference"]),
            but_lost(within(row["ratio"], row["low"], row["high"]), row["n_lost"]),
            *_test_columns(row),
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env", "explored steps", "variant", _reference(table), "success", "success of reference",
        "cost ratio [95 %]", "P(improvement)", "Wilcoxon p", "BH-adjusted p", "pairs",
    ]  # fmt: skip
    note = (
        "Success: share of the episodes of the variant and of the reference that succeed, planned "
        f"by the model learned so far. Cost ratio: {_RATIO}; geometric mean over seeds of the "
        "episode's cost; interval: paired BCa bootstrap of the log ratio, "
        f"{STUDENT_RANGE} pairs. P(improvement): share of seeds with the "
        f"lower cost, ties half. p: two-sided Wilcoxon signed-rank test of the log ratio, "
        f"{_TESTED}. Lost: pairs in no ratio, as one of the two episodes or the true model's has "
        "no finite cost; a lost episode counts as the worst in P(improvement) and p, one "
        "whose true model's was lost in neither. Trials that diverged before a step are left out."
    )
    return TextTable(headers, rows, note)


def hitting_times_table(table: pd.DataFrame, rule: str) -> TextTable:
    """Return the paired comparison of the steps to a loss."""
    rows = [
        [
            row["env"],
            row["variant"],
            row["reference"],
            number(row["epsilon"]),
            steps_text(row["median"], row["horizon"]),
            steps_text(row["median_reference"], row["horizon"]),
            f"{row['reached']}/{row['n_pairs']}",
            f"{row['reached_reference']}/{row['n_pairs']}",
            *_test_columns(row),
        ]
        for row in table.to_dict("records")
    ]
    headers = [
        "env", "variant", _reference(table), "ε", "steps", "steps of reference", "reached",
        "reference reached",
        "P(earlier)", "sign p", "BH-adjusted p", "pairs",
    ]  # fmt: skip
    note = (
        "Steps: median number of inputs until the loss first is at most ε, of the variant and of "
        "the reference, over shared seeds (of an even number the upper one of two); ε: median "
        "final loss of random inputs unless --epsilon says otherwise. A trial that never gets "
        "there is censored at the horizon: later than any that does, a tie with another such. "
        "P(earlier): share of seeds on which the variant is earlier, "
        f"ties half. p: two-sided sign test, {_TESTED}. Diverged trials: {rule}."
    )
    return TextTable(headers, rows, note)


def _reference(table: pd.DataFrame) -> str:
    """Return the heading of the references: one of the environment, or one with the same setting.

    The column ``same`` names the settings that a variant shares with its reference; it is empty
    where no trial of the reference policy has these values.
    """
    same = set(table.get("same", [])) - {""}
    if not same:
        return "reference"
    [keys] = same
    return f"reference (same {keys}{', if stored' if '' in set(table['same']) else ''})"


def _test_columns(row: Mapping[Hashable, Any]) -> list[str]:
    """Return the share of seeds on which the variant is better, p, adjusted p, and the pairs.

    With the number of pairs comes how many trials of the two policies diverged, if any.
    """
    pairs = but_diverged(row["n_pairs"], row["n_diverged"])
    return [share(row["improvement"]), p_text(row["p_value"]), p_text(row["p_adjusted"]), pairs]


def gaps_table(gaps: Iterable[Gap]) -> TextTable:
    """Return the table of what is missing."""
    rows = [[gap.env, gap.policy, len(gap.seeds), gap.states, gap.describe_seeds()] for gap in gaps]
    return TextTable(["env", "policy", "missing", "state", "seeds"], rows)
