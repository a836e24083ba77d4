"""The section of a report on control: what the models of each variant were good for."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from analysis.control import ControlCurve, TrueModel, measure_control
from analysis.figures.style import environment_title
from analysis.numbers import but_lost, number, share, within
from analysis.report.variants import Field, Variant
from analysis.selection import Selection
from analysis.sheets import Sheet
from orchestrate.store import Reader

NOTE = (
    "Success: share of trials whose planned episode reached its goal, with the Wilson interval. "
    "Cost: geometric mean of the episode's cost by that of the true model under the same planner, "
    "noise and draws, with Student's interval. True model: what the same "
    "planner achieves that predicts with the true system, on the same seeds; no explored step "
    "changes it, and its cost is the unit. Lost: episodes in no mean of costs, as theirs or "
    "that of the true model is not finite; they are in the success. Free run: root mean square "
    "error of predictions that run free, beside the spread of what they predict, at the end of the "
    "trial, without those lost as the error is not finite."
)
FREE_RUN = "free_run_error"


def section(reader: Reader, fields: Sequence[Field]) -> str | None:
    """Return the section in Markdown, None where no trial has a task."""
    parts = [part for field in fields if (part := _part(reader, field))]
    if not parts:
        return None
    return "\n\n".join(["## Control with the learned model", NOTE, *parts])


def _part(reader: Reader, field: Field) -> str | None:
    assessed = field.assessed
    if not assessed:
        return None
    curves = measure_control(reader, Selection(tuple(one.entry for one in assessed)))
    steps = sorted({int(t) for curve in curves for t in curve.t})
    headers = [
        "variant",
        *(f"success after {t}" for t in steps),
        *(f"cost after {t}" for t in steps),
        "free run",
        "n",
    ]
    rows = [
        [
            one.label,
            *_cells(curve, steps),
            _free_run(reader, one, curve, steps[-1]),
            curve.described,
        ]
        for one, curve in zip(assessed, curves, strict=True)
    ]
    rows.append(_ceiling(curves[0].truth, len(steps)))
    return f"### {environment_title(field.env)}\n\n{Sheet(headers, rows).markdown()}"


def _ceiling(truth: TrueModel, columns: int) -> list[str]:
    """Return the row of the true model: the same after any number of steps, its cost the unit."""
    success = _rate(truth.success, truth.success_low, truth.success_high)
    cost = but_lost("1" if truth.lost < truth.n else number(math.nan), truth.lost)
    return ["true model", *[success] * columns, *[cost] * columns, number(math.nan), str(truth.n)]


def _cells(curve: ControlCurve, steps: Sequence[int]) -> list[str]:
    """Return the successes and the costs after each number of steps, a dash where there is none."""
    places = {int(t): k for k, t in enumerate(curve.t)}
    successes = [_success(curve, places[t]) if t in places else "–" for t in steps]
    return successes + [_cost(curve, places[t]) if t in places else "–" for t in steps]


def _success(curve: ControlCurve, k: int) -> str:
    return _rate(*(float(of[k]) for of in (curve.success, curve.success_low, curve.success_high)))


def _rate(centre: float, low: float, high: float) -> str:
    return share(centre) if math.isnan(low) else f"{centre:.2f} [{low:.2f}, {high:.2f}]"


def _cost(curve: ControlCurve, k: int) -> str:
    centre, low, high = (float(of[k]) for of in (curve.cost, curve.cost_low, curve.cost_high))
    return but_lost(within(centre, low, high), int(curve.lost[k]))


def _free_run(reader: Reader, variant: Variant, curve: ControlCurve, t: int) -> str:
    """Return the mean error after t steps, and of how many trials it is not finite."""
    found = reader.assessments(variant.entry.cell.config_key, FREE_RUN)
    errors = found.values[:, found.t == t]
    finite = errors[np.isfinite(errors)]
    reached = int(np.sum(curve.n[curve.t == t]))
    mean = float(np.mean(finite)) if len(finite) else math.nan
    return but_lost(number(mean), max(0, reached - len(finite)))
