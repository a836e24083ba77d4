"""Figure 2, left and middle: phase portraits, one panel per policy, same seed and axes."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from analysis.figures.axes import angle_ticks, rows_and_columns
from analysis.figures.legend import legend_below
from analysis.figures.phase_portraits.data import (
    SEED_RULE,
    DrawnPlane,
    Portrait,
    Portraits,
    measure_portraits,
    tabulate_portraits,
)
from analysis.figures.plot import Plot
from analysis.figures.style import TEXT_WIDTH, mathematical
from analysis.formatting import plus_minus
from analysis.line_styles import BLACK, environment_title, policy_style
from dopt.coverage import CELLS

PANEL_HEIGHT = 2.1
MARGIN = 0.04
BOX: dict[str, Any] = {
    "facecolor": "#f3f3f3",
    "edgecolor": "#707070",
    "linestyle": (0, (3, 2)),
    "linewidth": 0.8,
}


def phase_plot(env: str) -> Plot[Portraits]:
    """Return the phase portraits of one environment."""
    return Plot(
        name=f"figure2_phase_{env}",
        title=f"Phase portraits, {environment_title(env)}",
        statistic=f"one trajectory per policy: {SEED_RULE}; coverage: mean over trials",
        band="± 2 standard errors of the mean coverage (printed)",
        part=lambda selection: selection.only([env]).compared(),
        measure=lambda reader, selection, _: measure_portraits(reader, selection, env),
        tabulate=tabulate_portraits,
        draw=draw,
        caption=caption,
    )


def draw(portraits: Portraits) -> Figure:
    """Draw one panel for each policy, all with the same axes."""
    rows, columns = rows_and_columns(len(portraits.panels), 3)
    width = TEXT_WIDTH * max(columns, 2) / 3
    figure = Figure(figsize=(width, PANEL_HEIGHT * rows + 0.6), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, portrait in zip(panels, portraits.panels, strict=False):
        _panel(axes, portrait, portraits.plane)
    last = len(portraits.panels)
    for axes in panels[last:]:
        axes.set_axis_off()
    _set_axes(panels[0], portraits)
    x_label, y_label = (mathematical(label) for label in portraits.plane.labels)
    for index, axes in enumerate(panels[:last]):
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label if index % columns == 0 else "")
    handles = _handles(portraits.seed)
    if last < len(panels):
        panels[-1].legend(handles=handles, loc="center")
    else:
        legend_below(figure, min(3, columns + 1), handles=handles)
    return figure


def _panel(axes: Axes, portrait: Portrait, plane: DrawnPlane) -> None:
    (left, right), (bottom, top) = plane.box
    axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, zorder=0.5, **BOX))
    style = policy_style(portrait.policy)
    axes.plot(portrait.line[:, 0], portrait.line[:, 1], color=style.colour, lw=0.7, zorder=2)
    axes.plot(*portrait.start, marker="o", ms=4, mfc="white", mec=BLACK, mew=1, zorder=3)
    axes.set_title(
        f"{style.label}\n{coverage_text(portrait)} ({count_text(portrait)})", fontsize=7.5
    )
    if not len(portrait.line):
        axes.text(0.5, 0.5, "no finished trial", transform=axes.transAxes, ha="center")
    elif portrait.diverged:
        axes.text(0.06, 0.07, "this trial diverged", transform=axes.transAxes, fontsize=6.5)


def count_text(portrait: Portrait) -> str:
    """Return the number of trials behind the coverage."""
    left_out = f", {portrait.n_diverged} diverged" if portrait.n_diverged else ""
    return f"n = {portrait.n}{left_out}"


def coverage_text(portrait: Portrait) -> str:
    """Return the mean coverage in per cent ± 2 standard errors."""
    if not portrait.n:
        return "coverage unknown"
    error = portrait.coverage_error if portrait.n > 1 else 0.0
    return f"coverage {plus_minus(100 * portrait.coverage, 200 * error)} %"


def _set_axes(axes: Axes, portraits: Portraits) -> None:
    # Not by the axis, whose view interval the panels that share it would not see.
    axes.set(xlim=_limits(portraits, 0), ylim=_limits(portraits, 1))
    for dimension, axis in enumerate((axes.xaxis, axes.yaxis)):
        if portraits.plane.angles[dimension]:
            angle_ticks(axis)


def _limits(portraits: Portraits, dimension: int) -> tuple[float, float]:
    values = np.concatenate([panel.line[:, dimension] for panel in portraits.panels])
    values = np.concatenate([values[np.isfinite(values)], portraits.plane.box[dimension]])
    low, high = float(values.min()), float(values.max())
    margin = MARGIN * (high - low)
    return low - margin, high + margin


def _handles(seed: int) -> list[Line2D | Patch]:
    return [
        Line2D([], [], color="#404040", lw=0.9, label=f"trajectory of seed {seed}"),
        Line2D([], [], ls="", marker="o", ms=4, mfc="white", mec=BLACK, mew=1, label="start"),
        Patch(**BOX, label="evaluation box"),
    ]


def caption(portraits: Portraits) -> str:
    """Return the caption, with the rule for the seed and what coverage is."""
    return (
        f"Phase portraits of the {environment_title(portraits.env)}, one panel per policy, "
        f"all of seed {portraits.seed} ({SEED_RULE}). Angles are wrapped around the stable "
        f"equilibrium and the line is broken where it wraps. Circle: start. Dashed: evaluation "
        f"box. Coverage: share of the {CELLS} × {CELLS} cells of that box which a trial visits, "
        f"mean over n trials ± 2 standard errors."
    )
