"""Figure 9: bounded states against time, limits counted only on the left, enforced on the right."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.data.missing_trials import ranges
from analysis.figures.legend import legend_below
from analysis.figures.limits.data import (
    MOST_SEEDS,
    Panel,
    Panels,
    limits_part,
    measure_panels,
    tabulate_panels,
)
from analysis.figures.plot import Plot
from analysis.figures.style import GUIDE, TEXT_WIDTH, mathematical
from analysis.formatting import but_diverged, plus_minus
from analysis.line_styles import BLUE, GREY, environment_title
from dopt.policies.titles import policy_title

ROW_HEIGHT = 1.75
LEGEND_HEIGHT = 0.4
WIDTHS = 3.0
"""Height of a panel at most, in widths of the bounds."""

MARGIN = 0.04
COLOURS = {False: GREY, True: BLUE}
WORDS = {False: "counted only", True: "enforced"}


def limits_plot(name: str) -> Plot[Panels]:
    """Return the bounded states of trials with limits."""
    return Plot(
        name=name,
        title="States with limits, counted only and enforced",
        statistic="states of single trials; mean over trials of the share of steps beyond a bound",
        band="± 2 standard errors of the mean share (printed)",
        part=limits_part,
        measure=lambda reader, selection, _: measure_panels(reader, selection),
        tabulate=tabulate_panels,
        draw=draw,
        caption=caption,
    )


def draw(panels: Panels) -> Figure:
    """Draw a row for each configuration and bounded state, a column for limits of either kind."""
    rows = rows_of(panels)
    kinds = sorted({panel.enforced for panel in panels})
    size = (TEXT_WIDTH * (1.0 if len(kinds) > 1 else 0.62), ROW_HEIGHT * len(rows) + LEGEND_HEIGHT)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(rows), len(kinds), squeeze=False)
    for line, row in zip(grid, rows, strict=True):
        for axes, kind in zip(line, kinds, strict=True):
            own = [panel for panel in row if panel.enforced == kind]
            if not own:
                axes.set_axis_off()
                continue
            _panel(axes, own[0])
            axes.set_ylim(*view(row))
            axes.set_ylabel(mathematical(own[0].state) if own[0] is row[0] else "")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    names = {kind: f"one trial, limits {WORDS[kind]}" for kind in kinds}
    handles = [Line2D([], [], color=COLOURS[kind], lw=0.8, label=names[kind]) for kind in kinds]
    handles.append(Line2D([], [], **GUIDE, label="bound"))
    legend_below(figure, 3, handles=handles)
    return figure


def rows_of(panels: Panels) -> list[list[Panel]]:
    """Return the panels of each configuration and state, in their order."""
    rows: dict[tuple[str, str, str], list[Panel]] = {}
    for panel in panels:
        rows.setdefault((panel.env, panel.label, panel.state), []).append(panel)
    return list(rows.values())


def view(row: Sequence[Panel]) -> tuple[float, float]:
    """Return the limits of the axis of a row: all that is drawn, near the bounds.

    That is within :data:`WIDTHS` widths of the bounds around their middle. Of a single bound, the
    width is twice its distance from the first state, which is the middle.
    """
    drawn = np.concatenate([panel.lines.ravel() for panel in row])
    drawn = drawn[np.isfinite(drawn)]
    low, high = (float(bound) for bound in row[0].bounds)
    edges = [bound for bound in (low, high) if math.isfinite(bound)]
    middle, width = 0.5 * (low + high), high - low
    if len(edges) < 2:
        middle = float(drawn[0]) if len(drawn) else edges[0]
        width = 2.0 * abs(edges[0] - middle) or math.inf
    values = np.concatenate([drawn, edges])
    half = 0.5 * WIDTHS * width
    low, high = max(values.min(), middle - half), min(values.max(), middle + half)
    margin = MARGIN * (high - low)
    return low - margin, high + margin


def _panel(axes: Axes, panel: Panel) -> None:
    axes.plot(panel.time, panel.lines.T, color=COLOURS[panel.enforced], lw=0.5, alpha=0.7)
    for bound in panel.bounds[np.isfinite(panel.bounds)]:
        axes.axhline(bound, **GUIDE)
    axes.set_xlim(panel.time[0], panel.time[-1])
    axes.set_title(
        f"{environment_title(panel.env)}: {panel.label}\n"
        f"{WORDS[panel.enforced]}: {share_text(panel)}",
        fontsize=7.5,
    )


def share_text(panel: Panel) -> str:
    """Return the share of steps beyond a bound in per cent ± 2 standard errors, and n."""
    count = f"n = {but_diverged(panel.n, panel.n_diverged)}"
    if not panel.n:
        return f"share unknown ({count})"
    error = panel.share_error if panel.n > 1 else 0.0
    return f"{plus_minus(100 * panel.share, 200 * error)} % of steps beyond ({count})"


def caption(panels: Panels) -> str:
    """Return the caption, with the drawn trials and what the share is."""
    drawn = {f"{environment_title(one.env)}, {one.label}": ranges(one.seeds) for one in panels}
    words = [f"{name}: {own}" for name, own in drawn.items()]
    seeds = "; ".join(words) if len(set(drawn.values())) > 1 else next(iter(drawn.values()))
    kinds = {panel.enforced for panel in panels}
    sides = "limits are counted only on the left and enforced on the right"
    only = f"limits are {WORDS[panels[0].enforced]}"
    return (
        f"States with bounds against time, {policy_title(panels[0].policy)}, a line for each "
        f"trial; {sides if len(kinds) > 1 else only}. Dashed: bounds. At most "
        f"{MOST_SEEDS} trials are drawn, those of the first seeds; drawn seeds: {seeds}. The axis "
        f"shows at most {WIDTHS:g} widths of the bounds, lines beyond it are cut off; angles are "
        f"not wrapped. Percentage: steps after which any state is beyond a bound, mean over n "
        f"trials ± 2 standard errors; of a trial that diverged, the steps before."
    )
