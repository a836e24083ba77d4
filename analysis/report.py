"""``python -m analysis report``: everything that a database holds, compared on one page.

The page is Markdown; its pictures and its numbers stand beside it.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Any

import pandas as pd

from analysis import outputs
from analysis.data.matching import Filter
from analysis.data.selection import Gap, Selection
from analysis.stats.curves import STUDENT_RANGE
from analysis.style import (
    but_diverged,
    but_lost,
    environment_title,
    number,
    p_text,
    share,
    steps_text,
    within,
)
from analysis.tables.rendering import (
    Columns,
    Row,
    incomplete,
    mean_text,
    ratio_text,
    records,
    rendered,
    sample_loss_columns,
    text_of,
)
from analysis.tables.variants import (
    SAME,
    SIGNIFICANCE,
    TRUTH,
    VariantGroup,
    adjust,
    tabulate_control_of,
    tabulate_group,
    variant_groups,
    verdict,
)
from dopt.policies import POLICIES
from orchestrate.errors import make_folder
from orchestrate.store import Reader

HELP = "compare every policy, model and learner with the reference, on one page"
NAME = "report"
CONTROL = f"{NAME}_control"

NOTE = (
    "Success: share of trials whose planned episode reached its goal, with the Wilson interval; "
    f"with a star where the adjusted p is below {SIGNIFICANCE}: exact McNemar test against the "
    "first row, paired over seeds, the false discovery rate of all variants and numbers of steps "
    "of the report (Benjamini-Hochberg). Cost: geometric mean of the episode's cost divided by the "
    "true model's under the same planner, noise and draws, with Student's interval. True model: "
    "the same planner with predictions of the true system, on the same seeds; no explored step "
    "changes it, and its cost is the unit. Lost: episodes left out of the mean of costs, as their "
    "cost or the true model's is not finite; they are in the success. Loss: on the grid after as "
    "many steps, geometric mean. Free run: root mean square error of predictions that run free, "
    "divided by the error of the prediction that nothing changes, mean at the end of the trial "
    "without trials whose error is not finite."
)

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
    "Sample loss, where it is stored: of a Gaussian process tuned by its evidence and fitted to "
    "the samples of each trial, mean ± 2 standard errors: what a policy collected, whatever its "
    "learner made of it.",
    "n: trials that did not diverge; by default diverged ones are in no mean and in no ratio.",
)


def run(options: argparse.Namespace, wanted: Filter) -> int:
    """Write the page, the pictures, the CSV and the provenance; 0."""
    from analysis.figures.panels import styled  # Matplotlib: other commands do without it
    from analysis.figures.reports import draw_forest

    with Reader.open(options.db) as reader, reader.moment() as moment:
        found = variant_groups(moment, wanted)
        gaps = [gap for group in found for gap in _gaps(group)]
        if gaps and not options.allow_partial:
            raise incomplete(gaps, "but all that are registered are", "--env, --policy and --where")
        table = adjust([tabulate_group(moment, group) for group in found])
        controlled = tabulate_control_of(moment, found)
        selection = Selection(tuple(one for group in found for one in group.variants))
        facts = outputs.describe(moment, selection)
    make_folder(options.out)
    pictures = {}
    with styled():
        mark = outputs.fingerprint({"cells": facts["cells"], "selection": facts["selection"]})
        for env, rows in table.groupby("env", sort=False):
            pictures[str(env)] = f"{NAME}_{env}"
            title = f"Ratios of final losses: {env}"
            outputs.write_pictures(draw_forest(rows), options.out, pictures[str(env)], title, mark)
    outputs.write_table(table, options.out, NAME)
    if controlled is not None:
        outputs.write_table(controlled, options.out, CONTROL)
    notes = [f"{group.env}: {note}" for group in found for note in group.notes]
    if gaps:
        notes.insert(0, outputs.partial_warning(gaps))
    text = write_report(
        table, notes, _origin(facts, controlled=controlled is not None), pictures, controlled
    )
    outputs.write_text(text, options.out / outputs.PAGE)
    outputs.write_provenance(facts, options.out, NAME)
    sys.stdout.write(f"{options.out / outputs.PAGE}: {len(table)} variants\n")
    return 0


def _origin(facts: Mapping[str, Any], *, controlled: bool) -> str:
    versions, configs = facts["versions"], facts["cells"]
    trials = sum(config["n_finished"] for config in configs)
    control = f" and [{CONTROL}.csv]({CONTROL}.csv)" if controlled else ""
    return (
        f"Made by dopt {versions['dopt']} from {trials:,} trials of {len(configs)} configurations "
        f"in `{facts['database']}`. The numbers are in [{NAME}.csv]({NAME}.csv){control}, where "
        f"they come from in [{NAME}.json]({NAME}.json)."
    )


def _gaps(group: VariantGroup) -> Iterable[Gap]:
    """Yield what is registered of a variant and not finished.

    Variants may have different numbers of seeds: a ratio is over the shared ones.
    """
    for one in group.variants:
        missing = {trial.seed for trial in one.trials} - {trial.seed for trial in one.finished}
        if missing:
            yield Gap(group.env, one.label, tuple(sorted(missing)), f"{len(missing)} not finished")


def write_report(
    table: pd.DataFrame,
    notes: Sequence[str],
    origin: str,
    pictures: Mapping[str, str],
    controlled: pd.DataFrame | None = None,
) -> str:
    """Return the page of a table of :func:`analysis.tables.variants.adjust`.

    ``pictures`` are files, without their ending, by environment, and ``controlled`` is a table of
    :func:`tabulate_control_of`.
    """
    parts = {str(env): records(part) for env, part in table.groupby("env", sort=False)}
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
    ]
    if controlled is not None:
        sections.append(control_section(controlled))
    if notes:
        sections.append("## Notes\n\n" + "\n".join(f"- {note}" for note in notes))
    return "\n\n".join(sections) + "\n"


def _finding(env: str, rows: Sequence[Row]) -> str:
    """Return what is better, what worse, and what is not told apart, the best first."""
    said = [f"  - {line}" for line in _judged(rows[1:], "loss")]
    for reference, same in _same_settings(rows).items():
        said += [f"  - against {reference}, {line}" for line in _judged(same, f"{SAME}_loss")]
    turned = [
        f"{row['variant']} ({number(row['reachable_loss_ratio'])})"
        for row in rows[1:]
        if {verdict(row), verdict(row, "reachable_loss")} == {"better", "worse"}
    ]
    if turned:
        said.append(f"  - the other way round on the reachable set: {'; '.join(turned)}")
    return "\n".join([f"- **{environment_title(env)}** (ratio, p < {SIGNIFICANCE})", *said])


def _judged(rows: Sequence[Row], measure: str) -> list[str]:
    """Return which rows are better, worse and not told apart, the best first."""
    judged: dict[str, list[str]] = {"better": [], "worse": [], "open": []}
    for row in sorted(rows, key=lambda row: row[f"{measure}_ratio"]):
        words = f"{row['variant']} ({number(row[f'{measure}_ratio'])})"
        judged[verdict(row, measure)].append(words)
    names = {"better": "better", "worse": "worse", "open": "not told apart"}
    return [f"{names[kind]}: {'; '.join(found) or 'none'}" for kind, found in judged.items()]


def _same_settings(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group the rows by the reference under the same setting, without the report's reference."""
    groups: dict[str, list[Row]] = {}
    for row in rows[1:]:
        reference = str(row[f"{SAME}_reference"])
        if reference not in ("", rows[0]["variant"]):
            groups.setdefault(reference, []).append(row)
    return groups


def _described(table: pd.DataFrame) -> str:
    """Return what each policy of the package does, in the words of its class."""
    labels = dict(zip(table["policy"], table["policy_label"], strict=True))
    words = {name: (POLICIES[name].__doc__ or "").strip() for name in labels if name in POLICIES}
    return "\n".join(f"- {labels[name]}: {text.splitlines()[0]}" for name, text in words.items())


def _section(env: str, rows: Sequence[Row], picture: str | None) -> str:
    title = environment_title(env)
    epsilon, dt = rows[0]["epsilon"], rows[0]["dt"]
    facts = f"{rows[0]['horizon']} steps of dt = {1e3 * dt:g} ms."
    if not math.isnan(epsilon):
        facts += f" ε = {number(epsilon)}."
    parts = [f"## {title}", facts]
    if picture is not None:
        parts.append(f"![Ratios of final losses: {title}]({picture}.png)")
    losses = (*LOSSES, *sample_loss_columns("sample_loss" in rows[0]))
    parts += [rendered(rows, columns).markdown() for columns in (losses, EFFORT)]
    return "\n\n".join(parts)


def _steps(row: Row) -> str:
    steps = steps_text(row["steps"], row["horizon"])
    return steps if math.isnan(row["reached"]) else f"{steps} ({share(row['reached'])})"


LOSSES: Columns = (
    ("variant", itemgetter("variant")),
    ("final loss", mean_text("loss")),
    ("ratio [95 %]", ratio_text("loss_")),
    ("adjusted p", text_of("loss_p_adjusted", p_text)),
    ("same setting, ratio", ratio_text(f"{SAME}_loss_")),
    ("adjusted p", text_of(f"{SAME}_loss_p_adjusted", p_text)),
    ("reachable set, ratio", ratio_text("reachable_loss_")),
    ("curve, ratio", ratio_text("auc_")),
    ("n", lambda row: but_diverged(row["n"], row["n_diverged"])),
)
EFFORT: Columns = (
    ("variant", itemgetter("variant")),
    ("steps to ε (share)", _steps),
    ("adjusted p", text_of("steps_p_adjusted", p_text)),
    ("coverage", mean_text("coverage")),
    ("control cost, ratio", lambda row: but_lost(ratio_text("control_")(row), row["control_lost"])),
    ("plan [µs]", text_of("plan_us", number)),
    ("learn [µs]", text_of("learn_us", number)),
    ("runs on", itemgetter("path")),
)


def control_section(table: pd.DataFrame) -> str:
    """Return the section in Markdown of a table of :func:`tabulate_control_of`."""
    parts = [_part(str(env), records(rows)) for env, rows in table.groupby("env", sort=False)]
    return "\n\n".join(["## Control with the learned model", NOTE, *parts])


def _part(env: str, table: Sequence[Row]) -> str:
    """Return two tables of an environment, a row for each variant, columns by explored steps."""
    rows: dict[str, dict[Any, Row]] = {}
    for row in table:
        rows.setdefault(row["variant"], {})[row["t"]] = row
    steps = sorted({row["t"] for row in table})

    def after(t: int, text: Callable[[Row], object]) -> Callable[[Mapping[Any, Row]], object]:
        return lambda row: text(row[t]) if t in row else "–"

    success: Columns = (
        *((f"success after {t}", after(t, _success)) for t in steps),
        ("n", lambda row: row[max(row)]["described"]),
    )
    worth: Columns = (
        *((f"cost after {t}", after(t, _cost)) for t in steps),
        *((f"loss after {t}", after(t, text_of("loss", number))) for t in steps if t),
        ("free run", after(steps[-1], _free_run)),
    )
    name = ("variant", lambda row: next(iter(row.values()))["variant"])
    tables = [rendered(rows.values(), (name, *own)).markdown() for own in (success, worth)]
    return "\n\n".join([f"### {environment_title(env)}", *tables])


def _success(row: Row) -> str:
    centre, low, high = (row[f"success{end}"] for end in ("", "_low", "_high"))
    star = "*" if row["success_p_adjusted"] < SIGNIFICANCE else ""
    return number(math.nan) if math.isnan(low) else f"{centre:.2f}{star} [{low:.2f}, {high:.2f}]"


def _cost(row: Row) -> str:
    centre, low, high = (row[f"cost{end}"] for end in ("", "_low", "_high"))
    alone = "1" if row["variant"] == TRUTH and centre == 1 else number(centre)
    return but_lost(alone if math.isnan(low) else within(centre, low, high), row["lost"])


def _free_run(row: Row) -> str:
    if row["variant"] == TRUTH:
        return number(math.nan)
    return but_lost(number(row["free_run"]), int(row["free_run_lost"]))
