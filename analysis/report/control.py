"""The section of a report on control: what the models of each variant were good for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from analysis.control import ControlCurve, measure_control
from analysis.figures.style import environment_title
from analysis.numbers import number, within
from analysis.report.variants import Field, Variant
from analysis.selection import Selection
from analysis.sheets import Sheet
from orchestrate.store import Reader

NOTE = (
    "Success: share of trials whose planned episode reached its goal, with the Wilson interval. "
    "Cost: geometric mean of the episode's cost by that of the true model under the same planner, "
    "noise and draws, with Student's interval. Free run: root mean square error of predictions "
    "that run free, beside the spread of what they predict, at the end of the trial."
)
FREE_RUN = "free_run_error"


def has_task(variant: Variant) -> bool:
    """Whether the trials of a variant were assessed."""
    return bool(variant.entry.cell.config.get("task")) and bool(variant.entry.final_losses())


def section(reader: Reader, fields: Sequence[Field]) -> str | None:
    """Return the section in Markdown, None where no trial has a task."""
    parts = [part for field in fields if (part := _part(reader, field))]
    if not parts:
        return None
    return "\n\n".join(["## Control with the learned model", NOTE, *parts])


def _part(reader: Reader, field: Field) -> str | None:
    assessed = [one for one in field.variants if has_task(one)]
    if not assessed:
        return None
    curves = measure_control(reader, Selection(tuple(one.entry for one in assessed)))
    steps = curves[0].t.tolist()
    headers = [
        "variant",
        *(f"success after {t}" for t in steps),
        *(f"cost after {t}" for t in steps),
        "free run",
        "n",
    ]
    rows = [
        [one.label, *_cells(curve), _free_run(reader, one), curve.described]
        for one, curve in zip(assessed, curves, strict=True)
    ]
    return f"### {environment_title(field.env)}\n\n{Sheet(headers, rows).markdown()}"


def _cells(curve: ControlCurve) -> list[str]:
    successes = zip(curve.success, curve.success_low, curve.success_high, strict=True)
    costs = zip(curve.cost, curve.cost_low, curve.cost_high, strict=True)
    return [
        *(f"{rate:.2f} [{low:.2f}, {high:.2f}]" for rate, low, high in successes),
        *(within(*cost) for cost in costs),
    ]


def _free_run(reader: Reader, variant: Variant) -> str:
    values = reader.assessments(variant.entry.cell.config_key, FREE_RUN).values
    last = values[:, -1] if values.size else np.empty(0)
    return number(float(np.nanmean(last))) if np.isfinite(last).any() else number(math.nan)
