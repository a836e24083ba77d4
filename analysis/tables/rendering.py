"""Kinds of tables: what each one needs, how it is measured, and its Markdown or LaTeX."""

from __future__ import annotations

import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd
from tabulate import tabulate

from analysis.data.matching import AnalysisError, IncompleteError
from analysis.data.samples import learned_model, sample_losses, simulated_trial
from analysis.data.selection import Entry, Gap, Selection, ranges
from analysis.stats.curves import STUDENT_RANGE, PlotOptions
from analysis.stats.scores import Measure, geometric_mean
from analysis.style import (
    but_diverged,
    number,
    p_text,
    plus_minus,
    share,
    steps_text,
    within,
)
from analysis.tables.comparisons import (
    EPSILON_POLICY,
    aggregate,
    compare_policies,
    compare_steps,
    summarise,
)
from dopt.assessment import SAMPLE_LOSS
from dopt.errors import SpecificationError, counted
from dopt.offline_fit import HeldOutFit, held_out_fit, sample_loss
from dopt.result import Assessment
from orchestrate.store import QueryError, Reader

_IN_LATEX = {"±": r"$\pm$", "–": "--", "−": "$-$", "≤": r"$\leq$", "≥": r"$\geq$", "×": r"$\times$"}
_IN_LATEX |= {"[": "{[}", "|": "$|$"}
_IN_LATEX |= {"ε": r"$\varepsilon$", "φ": r"$\varphi$", "µ": r"$\mu$", "²": "$^2$", "·": r"$\cdot$"}

_SIGNS = str.maketrans({"±": "+-", "×": "x", "≤": "<=", "≥": ">=", "–": "-", "−": "-", "‖": "|"})
"""Signs whose names say nothing by their last word, as ASCII."""

_JUDGED = {
    Measure.FINAL: "final loss",
    Measure.AUC: "loss over the whole curve (geometric mean over the steps)",
}

_RATIO = "variant / reference, below 1 the variant is better"
_TESTED = "then adjusted over the table (Benjamini-Hochberg)"
CALIBRATION_HELP = "fit at held-out states, coverage of their intervals, energy of the inputs"
SETS = ("grid", "reachable")


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

        Everything is ASCII, signs and Greek letters are commands: it compiles with every engine.
        """
        note = "".join(f"% {_ascii(line)}\n" for line in self.note.splitlines())
        table = tabulate(self.rows, headers=self.headers, tablefmt="latex", disable_numparse=True)
        return note + "".join(map(_latex_letter, table)) + "\n"


def _latex_letter(letter: str) -> str:
    if letter in _IN_LATEX:
        return _IN_LATEX[letter]
    if letter.isascii():
        return letter
    name = unicodedata.name(letter, "")
    if name.startswith("GREEK SMALL LETTER "):
        return rf"$\{name.rpartition(' ')[2].lower().replace('lamda', 'lambda')}$"
    return _ascii(letter)


def _ascii(text: str) -> str:
    """Return the nearest ASCII text, letters without one as their names, no combining marks."""
    return "".join(
        letter if letter.isascii() else unicodedata.name(letter, "?").lower().rpartition(" ")[2]
        for letter in unicodedata.normalize("NFKD", text.translate(_SIGNS))
        if not unicodedata.combining(letter)
    )


Row = Mapping[str, Any]
Columns = Sequence[tuple[str, Callable[[Row], object]]]
"""Heading and text of each column."""


def rendered(rows: Iterable[Row] | pd.DataFrame, columns: Columns, note: str = "") -> TextTable:
    """Return rows as a table of texts."""
    found = records(rows) if isinstance(rows, pd.DataFrame) else rows
    texts = [[text(row) for _, text in columns] for row in found]
    return TextTable([heading for heading, _ in columns], texts, note)


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as mappings."""
    return [{str(name): value for name, value in row.items()} for row in table.to_dict("records")]


Text = Callable[[Row], str]

_NAMED: Columns = (("env", itemgetter("env")), ("variant", itemgetter("label")))
"""Columns that name a configuration."""


def text_of(column: str, words: Callable[[Any], str]) -> Text:
    """Return a function that writes one column of a row."""
    return lambda row: words(row[column])


def mean_text(column: str) -> Text:
    """Return a function that writes a column with its two standard errors."""
    return lambda row: plus_minus(row[column], row[f"{column}_2se"])


def ratio_text(prefix: str = "") -> Text:
    """Return a function that writes a ratio with its interval; ``prefix`` begins the columns."""
    return lambda row: within(*(row[f"{prefix}{name}"] for name in ("ratio", "low", "high")))


def _paired(table: pd.DataFrame, better: str, test: str, own: Columns) -> Columns:
    """Return the columns that all paired comparisons have around their own ones.

    The last ones are the share of seeds on which the variant is better, p, adjusted p, and the
    pairs, with how many trials of the two policies diverged, if any.
    """
    return (
        ("env", itemgetter("env")),
        ("variant", itemgetter("variant")),
        (_reference(table), itemgetter("reference")),
        *own,
        (f"P({better})", text_of("improvement", share)),
        (f"{test} p", text_of("p_value", p_text)),
        ("BH-adjusted p", text_of("p_adjusted", p_text)),
        ("pairs", lambda row: but_diverged(row["n_pairs"], row["n_diverged"])),
    )


def sample_loss_columns(stored: bool) -> Columns:
    """Return the column of the sample losses of a table, empty where none are stored."""
    return [("sample loss", mean_text("sample_loss"))] if stored else []


def summary_table(table: pd.DataFrame) -> TextTable:
    """Return the table of final losses: mean ± 2 SE, median, IQM and n."""
    columns: Columns = (
        *_NAMED,
        ("final loss", mean_text("loss")),
        ("median", text_of("loss_median", number)),
        ("IQM", text_of("loss_iqm", number)),
        ("final reachable-set loss", mean_text("reachable_loss")),
        *sample_loss_columns("sample_loss" in table),
        ("n", itemgetter("n")),
        ("diverged", itemgetter("n_diverged")),
    )
    note = (
        "Loss: mean ± 2 standard errors over n trials; IQM: mean of the middle half. "
        "Diverged trials are left out."
    )
    if "sample_loss" in table:
        note += " Sample loss: mean over the trials of which one is stored (analysis sample-loss)."
    return rendered(table, columns, note)


def comparison_table(table: pd.DataFrame, measure: Measure = Measure.FINAL) -> TextTable:
    """Return the paired comparison of losses."""
    columns = _paired(table, "improvement", "Wilcoxon", [("loss ratio [95 %]", ratio_text())])
    note = (
        f"Ratio: {_RATIO}; geometric mean over seeds of the "
        f"{_JUDGED[measure]}; interval: paired BCa bootstrap of the log ratio, {STUDENT_RANGE} "
        "pairs. P(improvement): share of seeds with the lower loss, ties half. "
        f"p: two-sided Wilcoxon signed-rank test of the log ratio, {_TESTED}. "
        "Diverged trials are left out."
    )
    return rendered(table, columns, note)


def aggregate_table(table: pd.DataFrame) -> TextTable:
    """Return the comparison over all systems."""
    columns: Columns = (
        ("variant", itemgetter("variant")),
        ("reference", itemgetter("reference")),
        ("loss ratio [95 %]", ratio_text()),
        ("systems", itemgetter("systems")),
        ("pairs", lambda row: but_diverged(row["n_pairs"], row["n_diverged"])),
    )
    note = (
        f"Ratio: {_RATIO}; geometric mean over systems, each counted alike, of the geometric mean "
        "over shared seeds of the final loss; interval: percentile bootstrap over pairs, "
        "stratified by system, Student's below 30 pairs of a system. Compare only rows of the "
        "same systems. Diverged trials are left out."
    )
    return rendered(table, columns, note)


def hitting_times_table(table: pd.DataFrame) -> TextTable:
    """Return the paired comparison of the steps to a loss."""
    own: Columns = (
        ("ε", text_of("epsilon", number)),
        ("steps", lambda row: steps_text(row["median"], row["horizon"])),
        ("steps of reference", lambda row: steps_text(row["median_reference"], row["horizon"])),
        ("reached", lambda row: f"{row['reached']}/{row['n_pairs']}"),
        ("reference reached", lambda row: f"{row['reached_reference']}/{row['n_pairs']}"),
    )
    columns = _paired(table, "earlier", "sign", own)
    note = (
        "Steps: median number of inputs until the loss first is at most ε, of the variant and of "
        "the reference, over shared seeds (of an even number the upper one of two); ε: median "
        "final loss of random inputs unless --epsilon says otherwise. A trial that never gets "
        "there is censored at the horizon: later than any that does, a tie with another such. "
        "P(earlier): share of seeds on which the variant is earlier, "
        f"ties half. p: two-sided sign test, {_TESTED}. Diverged trials are left out."
    )
    return rendered(table, columns, note)


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


def incomplete(gaps: Sequence[Gap], wanted: str, options: str) -> IncompleteError:
    """Return the error for trials that are missing; ``options`` narrow the request."""
    missing = sum(len(gap.seeds) for gap in gaps)
    rows = [[gap.env, gap.policy, len(gap.seeds), gap.states, ranges(gap.seeds)] for gap in gaps]
    table = TextTable(["env", "policy", "missing", "state", "seeds"], rows)
    return IncompleteError(
        f"{table.markdown()}\n\nerror: {counted(missing, 'trial')} missing, "
        f"{wanted} expected: run the launch again, narrow the request by {options}, "
        f"or give --allow-partial to go on with what there is."
    )


@dataclass(frozen=True)
class TableKind:
    """A kind of table; ``part`` cuts the selection, without entries the table is not made."""

    title: str
    part: Callable[[Selection, PlotOptions], Selection]
    measure: Callable[[Reader, Selection, PlotOptions], pd.DataFrame]
    render: Callable[[pd.DataFrame], TextTable]


def comparison(column: str, measure: Measure) -> TableKind:
    """Return the comparison of one measure of one column of losses."""
    where = "grid" if column == "loss" else "reachable set"
    if measure is Measure.STEPS:
        return TableKind(
            f"Steps to a loss, {where}",
            _raced,
            lambda reader, selection, options: compare_steps(
                reader, selection, column, options.epsilon
            ),
            hitting_times_table,
        )
    title = "Final loss" if measure is Measure.FINAL else "Loss over the whole curve"
    return TableKind(
        f"{title} against the reference, {where}",
        _compared,
        lambda reader, selection, _: compare_policies(reader, selection, column, measure),
        lambda table: comparison_table(table, measure),
    )


def _whole(selection: Selection, _: PlotOptions) -> Selection:
    return selection


def _compared(selection: Selection, _: PlotOptions) -> Selection:
    compared = selection.simulated().compared()
    return compared if len(compared.labels) > 1 else Selection(())


def _raced(selection: Selection, options: PlotOptions) -> Selection:
    """Return the environments that have the yardstick's trials too, if these give the loss."""
    compared = _compared(selection, options)
    if options.epsilon is not None:
        return compared
    return compared.only(
        entry.config.env
        for entry in compared.entries
        if entry.config.policy == EPSILON_POLICY and entry.final_losses()
    )


TABLES = {
    "summary": TableKind(
        "Final losses",
        _whole,
        lambda reader, selection, _: summarise(reader, selection),
        summary_table,
    ),
    "aggregate": TableKind(
        "Final loss against the reference, all systems",
        _compared,
        lambda reader, selection, _: aggregate(reader, selection),
        aggregate_table,
    ),
    "comparison": comparison("loss", Measure.FINAL),
    "comparison_auc": comparison("loss", Measure.AUC),
    "comparison_steps": comparison("loss", Measure.STEPS),
    "comparison_reachable": comparison("reachable_loss", Measure.FINAL),
}


def measure_calibration(reader: Reader, selection: Selection) -> pd.DataFrame:
    """Return medians over the trials that are done, one row for each environment and variant.

    Of each measure of :class:`dopt.offline_fit.HeldOutFit` on the grid and on the reachable set,
    and of the mean of ‖u‖²/γ² over the steps, ``energy``. Of the share covered it is the mean: that
    of all states of all trials.

    Raises
    ------
    AnalysisError
        If no selected trial is done.
    """
    entries = [one for one in selection.simulated().entries if one.final_losses()]
    if not entries:
        raise AnalysisError(
            "No selected trial is done, but the fit of a learned model needs some: run the grid, "
            "or ask for more."
        )
    return pd.DataFrame([_calibration_row(reader, entry) for entry in entries])


def _calibration_row(reader: Reader, entry: Entry) -> dict[str, object]:
    trials = pd.DataFrame([_calibrated_trial(reader, entry, seed) for seed in entry.final_losses()])
    shares = {f"{kind}_covered": trials[f"{kind}_covered"].mean() for kind in SETS}
    names = {"env": entry.config.env, "policy": entry.config.policy, "label": entry.label}
    return {**names, **trials.median(), **shares, "n": len(trials)}


def _calibrated_trial(reader: Reader, entry: Entry, seed: int) -> dict[str, float]:
    learned = learned_model(reader, entry.config, seed)
    stored = reader.trajectory(entry.config.config_key, seed)
    fits = held_out_fit(learned.spec, learned.parameters, stored.states, stored.inputs)
    row = {
        f"{kind}_{name}": float(getattr(fit, name))
        for kind, fit in zip(SETS, fits, strict=True)
        for name in HeldOutFit._fields
    }
    energy = np.mean(np.sum(stored.inputs**2, axis=1)) / learned.spec.system.gamma**2
    return row | {"energy": float(energy)}


def calibration_table(table: pd.DataFrame) -> TextTable:
    """Return the table for people."""
    measures = (
        *(("R²", "r_squared", number), ("within 90 %", "covered", share)),
        ("log loss", "log_loss", number),
    )
    columns: Columns = (
        *_NAMED,
        *(
            (f"{title}, {kind}", text_of(f"{kind}_{name}", text))
            for title, name, text in measures
            for kind in SETS
        ),
        ("energy", text_of("energy", number)),
        ("n", itemgetter("n")),
    )
    note = (
        "Accelerations on the evaluation grid and the reachable set, medians over n trials. Within "
        "90 %: share of all within their interval of 90 %; log loss: mean negative log likelihood "
        "[nat]; a dash where the model has no covariance. Energy: mean of ‖u‖²/γ²."
    )
    return rendered(table, columns, note)


CALIBRATION = TableKind(
    "Fit at held-out states",
    _whole,
    lambda reader, selection, _: measure_calibration(reader, selection),
    calibration_table,
)


SAMPLE_LOSS_HELP = (
    "loss of one model fitted to the samples of each trial, beside the trial's own final loss"
)

SAMPLE_LOSS_NOTE = (
    "Geometric means over n trials, with Student's interval of the logarithms. Sample loss: root "
    "mean square error over the evaluation grid of a Gaussian process, tuned by its evidence and "
    "fitted to the trial's own samples: what the policy collected. Final / sample: what the "
    "learner made of it, below 1 it is better than the process."
)

_MEANS = {"loss": "final loss", "sample_loss": "sample loss", "ratio": "final / sample"}

Keep = Callable[[Mapping[str, Assessment]], object]
"""Stores fitted sample losses by trial key."""


def measure_sample_losses(
    reader: Reader, selection: Selection, say: Callable[[str], object], keep: Keep
) -> pd.DataFrame:
    """Return geometric means with intervals, one row for each environment and variant.

    A stored sample loss is taken as it is, others are fitted. ``ratio`` is final / sample loss.

    Raises
    ------
    AnalysisError
        If no selected trial has a sample loss.
    """
    rows = []
    for entry in selection.entries:
        known = sample_losses(reader, entry)
        fitted, left = _fitted(reader, entry, known)
        for why, count in left.items():
            say(f"{entry.config.env}, {entry.label}, trials left out: {count}, {why}")
        new = [(trial, fitted[trial.seed]) for trial in entry.trials if trial.seed in fitted]
        keep({one.trial_key: Assessment(one.n_steps or 0, SAMPLE_LOSS, loss) for one, loss in new})
        if known or fitted:
            rows.append(_row(entry, {**known, **fitted}))
    if not rows:
        raise AnalysisError(
            "No selected trial has a sample loss, but at least one is needed: run the grid, or ask "
            "for trials that are done and whose models read states alone."
        )
    return pd.DataFrame(rows)


def _fitted(
    reader: Reader, entry: Entry, known: Mapping[int, float]
) -> tuple[dict[int, float], Counter[str]]:
    """Return the sample losses that are not known, by seed; and how many are left out, and why."""
    left = Counter("diverged" for trial in entry.trials if trial.status == "diverged")
    seeds = [seed for seed in entry.final_losses() if seed not in known]
    try:
        spec = simulated_trial(entry.config, 0)
        _ = spec.config.process
    except (AnalysisError, SpecificationError) as error:
        return {}, left + Counter({str(error): len(seeds)})
    fitted = {}
    for seed in seeds:
        try:
            stored = reader.trajectory(entry.config.config_key, seed)
            fitted[seed] = sample_loss(spec.with_seed(seed), stored.states, stored.inputs)
        except QueryError:
            left["their states and inputs are not stored"] += 1
        except SpecificationError as error:
            left[str(error)] += 1
    return fitted, left


def _row(entry: Entry, samples: Mapping[int, float]) -> dict[str, object]:
    losses = entry.final_losses()
    final, sample = (np.array([one[seed] for seed in samples]) for one in (losses, samples))
    row: dict[str, object] = {"env": entry.config.env, "policy": entry.config.policy}
    row["label"] = entry.label
    for name, values in zip(_MEANS, (final, sample, final / sample), strict=True):
        columns = (name, f"{name}_low", f"{name}_high")
        row |= zip(columns, geometric_mean(values), strict=True)
    return row | {"n": len(samples)}


def sample_loss_kind(say: Callable[[str], object], keep: Keep) -> TableKind:
    """Return the table; ``say`` is told what is left out, and ``keep`` gets what was fitted."""
    columns: Columns = (
        *_NAMED,
        *((f"{title} [95 %]", _mean_text(name)) for name, title in _MEANS.items()),
        ("n", itemgetter("n")),
    )
    return TableKind(
        "Final losses beside sample losses",
        _whole,
        lambda reader, selection, _: measure_sample_losses(reader, selection, say, keep),
        lambda table: rendered(table, columns, SAMPLE_LOSS_NOTE),
    )


def _mean_text(name: str) -> Text:
    return lambda row: within(*(row[f"{name}{end}"] for end in ("", "_low", "_high")))
