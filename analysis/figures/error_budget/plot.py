"""Error budgets: from the floor by exploration's and the learner's factor to the online loss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.figures.axes import log_limits, log_ticks, rows_and_columns
from analysis.figures.error_budget.data import Budget
from analysis.figures.legend import legend_below
from analysis.figures.loss_curves.plot import loss_label
from analysis.figures.style import TEXT_WIDTH
from analysis.formatting import count_text, number
from analysis.line_styles import BLUE, VERMILLION, environment_title, text_by_environment
from analysis.stats.geometric_means import Estimate
from analysis.stats.intervals import STUDENT_RANGE

TITLE = "Error budget"
STATISTIC = "geometric mean over trials of the losses and of their quotients"
BAND = f"95 % interval of the mean logarithm (BCa bootstrap, {STUDENT_RANGE} trials)"

COLOURS = {"exploration_factor": BLUE, "learner_factor": VERMILLION}
WORDS = {
    "exploration_factor": "exploration: recorded / uniform samples, fitted offline",
    "learner_factor": "learner: online / offline, recorded samples",
}
MARKERS = {"floor": "o", "offline": "D", "online": "s"}
MARKED = {
    "floor": "floor",
    "offline": "offline fit of recorded samples",
    "online": "online",
}
ROW_HEIGHT = 0.46
AROUND = 0.62
LEGEND_HEIGHT = 0.5
SHIFT = 0.13
"""Distance of the two segments of a row from its middle, so that a factor below 1 is seen too."""


def draw(budgets: Sequence[Budget], units: Mapping[str, str]) -> Figure:
    """Draw a panel for each environment, a row for each configuration; ``units`` of the losses."""
    environments = list(dict.fromkeys(budget.env for budget in budgets))
    rows, columns = rows_and_columns(len(environments), 2)
    own = [[budget for budget in budgets if budget.env == env] for env in environments]
    tallest = [max(map(len, own[i * columns : (i + 1) * columns])) for i in range(rows)]
    height = sum(AROUND + ROW_HEIGHT * n for n in tallest) + LEGEND_HEIGHT
    figure = Figure(figsize=(TEXT_WIDTH, height), layout="constrained")
    ratios = [AROUND + ROW_HEIGHT * n for n in tallest]
    panels = figure.subplots(rows, columns, squeeze=False, height_ratios=ratios).ravel()
    for axes, part in zip(panels, own, strict=False):
        _panel(axes, part)
        axes.set_xlabel(loss_label("loss", units[part[0].env]))
    for axes in panels[len(own) :]:
        axes.remove()
    legend_below(figure, 2, handles=_handles())
    return figure


def _panel(axes: Axes, budgets: Sequence[Budget]) -> None:
    for place, budget in enumerate(reversed(budgets)):
        _segment(axes, place + SHIFT, budget.floor, budget.offline, "exploration_factor", budget)
        _segment(axes, place - SHIFT, budget.offline, budget.online, "learner_factor", budget)
        axes.plot([budget.offline.value] * 2, [place - SHIFT, place + SHIFT], color="black", lw=0.6)
        for name, shift in (("floor", SHIFT), ("offline", 0.0), ("online", -SHIFT)):
            _dot(axes, place + shift, getattr(budget, name), MARKERS[name])
    axes.set_title(f"{environment_title(budgets[0].env)} ({counts(budgets)})")
    parts = [getattr(budget, name) for budget in budgets for name in MARKERS]
    drawn = np.array([(part.value, part.low, part.high) for part in parts])
    limits = log_limits(drawn.ravel(), margin=1.5)
    axes.set_xscale("log")
    axes.set_xlim(*limits)
    log_ticks(axes.xaxis, *limits)
    axes.set_yticks(range(len(budgets)), [budget.label for budget in reversed(budgets)])
    axes.set_ylim(-0.55, len(budgets) - 0.45)
    axes.grid(axis="y", visible=False)


def _segment(
    axes: Axes, place: float, start: Estimate, end: Estimate, name: str, budget: Budget
) -> None:
    factor: Estimate = getattr(budget, name)
    above = name == "exploration_factor"
    colour = COLOURS[name]
    axes.plot([start.value, end.value], [place] * 2, color=colour, lw=4, solid_capstyle="butt")
    if np.isfinite(factor.value):
        axes.annotate(
            f"×{number(factor.value, 2)}", (float(np.sqrt(start.value * end.value)), place),
            xytext=(0, 3 if above else -3), textcoords="offset points", ha="center",
            va="bottom" if above else "top", fontsize=6, color=colour,
        )  # fmt: skip


def _dot(axes: Axes, place: float, part: Estimate, marker: str) -> None:
    ends = np.nan_to_num([[part.value - part.low], [part.high - part.value]])
    axes.errorbar(
        part.value, place, xerr=ends, fmt=marker, color="black", ms=2.6, elinewidth=0.7,
        capsize=1.5, capthick=0.7,
    )  # fmt: skip


def _handles() -> list[Line2D]:
    segments = [
        Line2D([], [], color=colour, lw=4, label=WORDS[name]) for name, colour in COLOURS.items()
    ]
    return segments + [
        Line2D([], [], color="black", ls="", marker=marker, ms=3, label=MARKED[name])
        for name, marker in MARKERS.items()
    ]


def counts(budgets: Sequence[Budget]) -> str:
    """Return n of the configurations of an environment, as a text."""
    return count_text({budget.label: str(budget.n) for budget in budgets})


def caption(budgets: Sequence[Budget], ridge: float) -> str:
    """Return the caption, with what each number is, n and the fits that did not converge."""
    numbers = text_by_environment(budgets, counts)
    unconverged = sum(budget.n_unconverged for budget in budgets)
    fits = f" Trials of which a fit did not converge: {unconverged}." if unconverged else ""
    return (
        "Error budget: loss on the evaluation grid, on a logarithmic axis. Floor: the model of the "
        "trial fitted offline (damped Gauss-Newton to convergence, from its initial parameters, "
        f"towards which a ridge of {ridge:g} draws it) to as many samples as the trial has steps, "
        "at states drawn uniformly from the evaluation box with the trial's noise. Above, blue: "
        "the factor by which an offline fit of the samples that the policy recorded is worse. "
        "Below, orange: the factor by which the loss of the online learner is worse than that. "
        "Factors multiply to online / floor; one below 1 points to the left. Geometric means over "
        f"trials with 95 % intervals (BCa bootstrap, {STUDENT_RANGE} trials).{fits} "
        f"{numbers}."
    )
