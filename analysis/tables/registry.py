"""Registry of tables: what each one needs, how it is measured, and how it is rendered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import pandas as pd

from analysis.data.trial_selection import Selection
from analysis.plot_options import PlotOptions
from analysis.stats.control import control_part
from analysis.stats.trial_scores import Measure
from analysis.tables.aggregate import aggregate
from analysis.tables.comparisons import (
    EPSILON_POLICY,
    compare_control,
    compare_policies,
    compare_steps,
)
from analysis.tables.rendering import (
    TextTable,
    aggregate_table,
    comparison_table,
    control_table,
    hitting_times_table,
    summary_table,
)
from analysis.tables.summary import summarise
from orchestrate.store import Reader


class Part(Protocol):
    """Cuts a selection down to what a table shows."""

    def __call__(self, selection: Selection, options: PlotOptions = ..., /) -> Selection: ...


@dataclass(frozen=True)
class TableKind:
    """A kind of table; ``part`` cuts the selection, without entries the table is not made."""

    title: str
    part: Part
    measure: Callable[[Reader, Selection, PlotOptions], pd.DataFrame]
    render: Callable[[pd.DataFrame, PlotOptions], TextTable]


def comparison(column: str, measure: Measure) -> TableKind:
    """Return the comparison of one measure of one column of losses."""
    where = "grid" if column == "loss" else "reachable set"
    if measure is Measure.STEPS:
        return TableKind(
            f"Steps to a loss, {where}", _raced, partial(_measure_steps, column=column), _race
        )
    title = "Final loss" if measure is Measure.FINAL else "Loss over the whole curve"
    return TableKind(
        f"{title} against the reference, {where}",
        _compared,
        partial(_measure_ratios, column=column, measure=measure),
        partial(_ratios, measure=measure),
    )


_DEFAULT = PlotOptions()


def _whole(selection: Selection, _: PlotOptions = _DEFAULT) -> Selection:
    return selection


def _compared(selection: Selection, _: PlotOptions = _DEFAULT) -> Selection:
    compared = selection.simulated().compared()
    return compared if len(compared.labels) > 1 else Selection(())


def _raced(selection: Selection, options: PlotOptions = _DEFAULT) -> Selection:
    """Return the environments that have the yardstick's trials too, if these give the loss."""
    compared = _compared(selection)
    if options.epsilon is not None:
        return compared
    return compared.only(
        entry.config.env
        for entry in compared.entries
        if entry.config.policy == EPSILON_POLICY and entry.final_losses()
    )


def _controlled(selection: Selection, _: PlotOptions = _DEFAULT) -> Selection:
    """Return the environments with a task in which the reference and a variant were assessed."""
    controlled = control_part(selection).compared()
    return controlled if len(controlled.labels) > 1 else Selection(())


def _measure_ratios(
    reader: Reader, selection: Selection, options: PlotOptions, column: str, measure: Measure
) -> pd.DataFrame:
    return compare_policies(reader, selection, column, options.rule, measure)


def _ratios(table: pd.DataFrame, options: PlotOptions, measure: Measure) -> TextTable:
    return comparison_table(table, options.rule, measure)


def _measure_steps(
    reader: Reader, selection: Selection, options: PlotOptions, column: str
) -> pd.DataFrame:
    return compare_steps(reader, selection, column, options.rule, options.epsilon)


def _race(table: pd.DataFrame, options: PlotOptions) -> TextTable:
    return hitting_times_table(table, options.rule)


TABLES = {
    "summary": TableKind(
        "Final losses",
        _whole,
        lambda reader, selection, options: summarise(reader, selection, options.rule),
        lambda table, options: summary_table(table, options.rule),
    ),
    "aggregate": TableKind(
        "Final loss against the reference, all systems",
        _compared,
        lambda reader, selection, options: aggregate(reader, selection, options.rule),
        lambda table, options: aggregate_table(table, options.rule),
    ),
    "comparison": comparison("loss", Measure.FINAL),
    "comparison_auc": comparison("loss", Measure.AUC),
    "comparison_steps": comparison("loss", Measure.STEPS),
    "comparison_reachable": comparison("reachable_loss", Measure.FINAL),
    "comparison_control": TableKind(
        "Cost of control against the reference",
        _controlled,
        lambda reader, selection, _: compare_control(reader, selection),
        lambda table, _: control_table(table),
    ),
}
