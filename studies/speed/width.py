"""Scaling of planning with the width of the network, in each form of the information matrix."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

from benchmarks.rows import Row, Target
from benchmarks.trials import TINY_GRID, cartpole
from dopt.run import run_trial
from dopt.spec.trial import TrialSpec
from studies.speed import show

WIDTHS = (8, 16, 32, 64, 128, 256)
LARGEST_MATRIX = 2**30
"""Bytes of M⁻¹ up to which the primal form is measured."""

SETTLED = 40
"""Steps of a trial in the primal form."""

LAST = 24
"""Steps at the end of the trial over which the mean is taken, whole cycles of the pending rows."""

FORMS = ("primal", "dual")

WIDEST, WIDEST_FORMS = 1024, ("dual", "sketch")


def measure(quick: bool) -> list[Row]:
    """Return microseconds of planning at the end of 500 steps, and exponents of q.

    The primal form costs the same in every step; with the dual form the last of many is dearest.
    """
    widths, horizon = WIDTHS[:4] if quick else WIDTHS, 60 if quick else 500
    rows = [row for form in FORMS for row in _form(form, widths, horizon)]
    return rows + [_widest(form, horizon) for form in WIDEST_FORMS]


def _widest(form: str, horizon: int) -> Row:
    spec = _trial(form, WIDEST, horizon)
    note = f"q = {spec.model.n_parameters(spec.system):,}"
    what = f"{form}, width {WIDEST:,}"
    return Row(what, _planning_us(spec), "µs", Target(6, 5_000), note=note)


def _form(form: str, widths: tuple[int, ...], horizon: int) -> Iterator[Row]:
    sizes, costs = [], []
    for width in widths:
        steps = SETTLED if form == "primal" else horizon
        spec = _trial(form, width, steps)
        q = spec.model.n_parameters(spec.system)
        if form == "primal" and 8 * q * q > LARGEST_MATRIX:
            note = f"M⁻¹ of {q:,} parameters takes {8e-9 * q * q:.1f} GB"
            yield Row(f"{form}, width {width}", None, note=note)
            continue
        costs.append(_planning_us(spec))
        sizes.append(q)
        yield Row(f"{form}, width {width}", costs[-1], "µs", note=f"q = {q:,}")
    target = Target(6, 1) if form == "dual" else None
    yield Row(f"{form}, exponent of q", _slope(sizes, costs), "", target, note=_SLOPE)


_SLOPE = "log-log slope over the upper half of the widths"


def _trial(form: str, width: int, horizon: int) -> TrialSpec:
    return cartpole(learner="adam", width=width, form=form, horizon=horizon, grid=TINY_GRID)


def _planning_us(spec: TrialSpec) -> float:
    return float(run_trial(spec).plan_us[-LAST:].mean())


def _slope(sizes: list[int], costs: list[float]) -> float:
    """Return the exponent of the power law fitted to the upper half, at least three points."""
    upper = -max(3, len(sizes) // 2)
    return float(np.polyfit(np.log(sizes[upper:]), np.log(costs[upper:]), 1)[0])


if __name__ == "__main__":
    show(measure("--quick" in sys.argv))
