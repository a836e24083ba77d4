"""All tables by name: what each needs, how it is measured, and how a person reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import pandas as pd

from analysis.comparisons import YARDSTICK, compare_control, compare_policies, compare_steps
from analysis.control import control_part
from analysis.measures import Measure
from analysis.request import Request
from analysis.selection import Selection
from analysis.sheets import Sheet, comparison_sheet, control_sheet, race_sheet, summary_sheet
from analysis.summary import summarise
from orchestrate.store import Reader


class Part(Protocol):
    """Cuts a selection down to what a table shows."""

    def __call__(self, selection: Selection, request: Request = ..., /) -> Selection: ...


@dataclass(frozen=True)
class TableKind:
    """A kind of table; ``part`` cuts the selection, without entries the table is not made."""

    title: str
    part: Part
    measure: Callable[[Reader, Selection, Request], pd.DataFrame]
    sheet: Callable[[pd.DataFrame, Request], Sheet]


def comparison(column: str, measure: Measure) -> TableKind:
    """Return the comparison of one measure of one column of losses."""
    where = "grid" if column == "loss" else "reachable set"
    if measure is Measure.STEPS:
        return TableKind(
            f"Steps to a loss, {where}", _raced, partial(_measure_steps, column=column), _race
        )
    title = "Final loss" if measure is Measure.FINAL else "Loss over the whole curve"
    return TableKind(
        f"{title} against every baseline, {where}",
        _compared,
        partial(_measure_ratios, column=column, measure=measure),
        partial(_ratios, measure=measure),
    )


_DEFAULT = Request()


def _whole(selection: Selection, _: Request = _DEFAULT) -> Selection:
    return selection


def _compared(selection: Selection, _: Request = _DEFAULT) -> Selection:
    compared = selection.compared()
    return compared if len(compared.policies) > 1 else Selection(())


def _raced(selection: Selection, request: Request = _DEFAULT) -> Selection:
    """Return the environments that have the yardstick's trials too, if these give the loss."""
    compared = _compared(selection)
    if request.epsilon is not None:
        return compared
    return compared.only(
        entry.cell.env
        for entry in compared.entries
        if entry.cell.policy == YARDSTICK and entry.final_losses()
    )


def _controlled(selection: Selection, _: Request = _DEFAULT) -> Selection:
    """Return the environments with a task in which the reference has a baseline."""
    controlled = control_part(selection).compared()
    return controlled if len(controlled.policies) > 1 else Selection(())


def _measure_ratios(
    reader: Reader, selection: Selection, request: Request, column: str, measure: Measure
) -> pd.DataFrame:
    return compare_policies(reader, selection, column, request.rule, measure)


def _ratios(table: pd.DataFrame, request: Request, measure: Measure) -> Sheet:
    return comparison_sheet(table, request.rule, measure)


def _measure_steps(
    reader: Reader, selection: Selection, request: Request, column: str
) -> pd.DataFrame:
    return compare_steps(reader, selection, column, request.rule, request.epsilon)


def _race(table: pd.DataFrame, request: Request) -> Sheet:
    return race_sheet(table, request.rule)


TABLES = {
    "summary": TableKind(
        "Final losses",
        _whole,
        lambda reader, selection, request: summarise(reader, selection, request.rule),
        lambda table, request: summary_sheet(table, request.rule),
    ),
    "comparison": comparison("loss", Measure.FINAL),
    "comparison_auc": comparison("loss", Measure.AUC),
    "comparison_steps": comparison("loss", Measure.STEPS),
    "comparison_reachable": comparison("reachable_loss", Measure.FINAL),
    "comparison_control": TableKind(
        "Cost of control against every baseline",
        _controlled,
        lambda reader, selection, _: compare_control(reader, selection),
        lambda table, _: control_sheet(table),
    ),
}
